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
        self, what: str, *, where: object = None, expected: object = None, found: object = None, do: str | None = None
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

    @property
    def line(self) -> str:
        """What is wrong, what was found and what to do, in one line."""
        found, do = (" ".join(str(self.details[name] or "").split()) for name in ("found", "do"))
        return self.what + (f": {found}" if found else "") + (f"; {do}" if do else "")

    def __reduce__(self) -> tuple[object, ...]:
        # Keyword arguments need help to cross a process border.
        return partial(type(self), self.what, **self.details), ()


class MachineError(UserError):
    """The machine's fault, not the input's: no space, no memory, a folder that can't be written."""
