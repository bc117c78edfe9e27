"""The one exception for what a user can cause, and how it's shown."""

from functools import partial
from typing import Any

_MAX_PATH = 1000  # of a path as it is shown; a damaged log may name longer ones


class UserError(Exception):
    """Something in the user's input, settings or machine that stops the work.

    Says what is wrong, where, what was expected, what was found and what to do about it; the command lines print it
    in a few lines and exit with 2.
    """

    def __init__(
        self,
        what: str,
        *,
        where: object = None,
        expected: object = None,
        found: object = None,
        do: str | None = None,
    ) -> None:
        self.what = what
        self.details: dict[str, Any] = {"where": where, "expected": expected, "found": found, "do": do}
        super().__init__(str(self))

    def __str__(self) -> str:
        lines = [self.what]
        texts = {name: str(value) for name, value in self.details.items() if value is not None}
        if len(texts.get("where", "")) > _MAX_PATH:
            texts["where"] = f"{texts['where'][:_MAX_PATH]} … ({len(texts['where'])} characters)"
        lines += [f"  {name + ':':<10}{text}" for name, text in texts.items()]
        return "\n".join(lines)

    def __reduce__(self) -> tuple[object, ...]:
        # Keyword arguments need help to cross a process border.
        return partial(type(self), self.what, **self.details), ()
