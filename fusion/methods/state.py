"""A localiser's state as JSON has it, and back: data alone, so that a state from elsewhere runs no code."""

import base64
import io
from collections import deque
from typing import Any

import numpy as np

from groundwalk.store import UserError

_ARRAY = "npy"


def plain(value: Any) -> Any:
    """A value as JSON has it: objects and dictionaries as their attributes, arrays as NumPy's files, in base64."""
    if isinstance(value, np.ndarray):
        file = io.BytesIO()
        np.save(file, value, allow_pickle=False)
        return {_ARRAY: base64.b64encode(file.getvalue()).decode()}
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, tuple | list | deque):
        return [plain(item) for item in value]
    if isinstance(value, dict) or hasattr(value, "__dict__"):
        content = value if isinstance(value, dict) else vars(value)
        return {name: plain(item) for name, item in content.items()}
    return value


def restore_into(owner: object, state: Any, kept: tuple[str, ...] = ()) -> None:
    """Give an object the attributes that `plain` was given, but those that are `kept`; the ones that it has say of what
    kind each is. UserError where it has others."""
    own = {name: value for name, value in getattr(owner, "__dict__", {}).items() if name not in kept}
    if not isinstance(state, dict) or set(state) != set(own):
        raise UserError(
            "the state is of another method, or of another version of groundwalk",
            where=type(owner).__name__,
            expected=", ".join(own),
            found=", ".join(map(str, state)) if isinstance(state, dict) else type(state).__name__,
            do="begin anew, without it",
        )
    for name, value in state.items():
        setattr(owner, name, _restored(value, own[name]))


def _restored(value: Any, like: Any) -> Any:
    """What `plain` was given, with `like` in its place in a fresh object; a list in nothing's place was a tuple."""
    if isinstance(value, list):
        items = [_restored(item, None) for item in value]
        return (
            deque(items, like.maxlen) if isinstance(like, deque) else items if isinstance(like, list) else tuple(items)
        )
    if not isinstance(value, dict):
        return value
    if set(value) == {_ARRAY}:
        return np.load(io.BytesIO(base64.b64decode(value[_ARRAY])), allow_pickle=False)
    restore_into(like, value)
    return like
