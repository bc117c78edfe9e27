"""The fusion methods by id. A new one is a module with a `Localiser` and its options, and a line here."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from artefacts import UserError
from artefacts.settings import validated
from fusion.apr import Apr, AprOptions
from fusion.drift_aware import DriftAware, DriftAwareOptions
from fusion.localiser import Localiser, MethodOptions
from fusion.mobilearloc import MobileARLoc, MobileARLocOptions


@dataclass(frozen=True)
class Method:
    """How to make a localiser: `make(options)`; `options` is the settings model, whose values every result records."""

    id: str
    make: Callable[[Any], Localiser]
    options: type[MethodOptions]
    meaning: str


METHODS = {
    method.id: method
    for method in (
        Method("apr", Apr, AprOptions, "the raw regressor"),
        Method("mobilearloc", MobileARLoc, MobileARLocOptions, "the paper's rule"),
        Method("drift_aware", DriftAware, DriftAwareOptions, "slowly drifting alignment, from all the history"),
    )
}


def method(method_id: str) -> Method:
    """The method of that id; UserError where there is none."""
    if method_id not in METHODS:
        raise UserError(f"there is no fusion method {method_id!r}", expected=f"one of {', '.join(METHODS)}")
    return METHODS[method_id]


def resolve_options(method_id: str, values: dict[str, Any] | None = None) -> MethodOptions:
    """A method's options from a table of values; UserError for an unknown key or a value out of range."""
    return validated(method(method_id).options, values or {}, f"options of fusion method {method_id}")
