"""The fusion methods: what a record of one says, and those that there are."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any, ClassVar

from groundwalk.fusion.methods.localiser import MethodOptions
from groundwalk.store.registry import Colour, Entry, Registry, callable_faults, colour_faults
from groundwalk.store.settings import validated


@dataclass(frozen=True, kw_only=True)
class Method(Entry):
    """How to make a method: `make(options)`; `options` is the settings model, whose values every result records.

    make: a fresh one with a `step` as `Localiser` has it, or an `Offline` where causal is false.
    colour: of its poses in recordings. visible: recordings show it at first; others are switched on in the viewer.
    fuses: it uses odometry; the one that doesn't is the raw regressor, which the others are held against.
    causal: it answers a frame from that frame and the ones before it, as an app must. One that isn't makes an
    `Offline`, which sees whole walks; tables say so and never rank it with the causal ones.
    needs_vertical: odometry and map must both have +y up; a walk without gravity, or in a map without a vertical, comes
    without odometry.
    """

    noun: ClassVar[str] = "fusion method"

    colour: Colour
    make: Callable[..., Any] = field(repr=False)
    options: type[MethodOptions]
    causal: bool
    fuses: bool = True
    needs_vertical: bool = False
    visible: bool = False

    def faults(self) -> Iterable[str]:
        yield from super().faults()
        yield from colour_faults(self.colour)
        yield from callable_faults(self, ["make"])
        if not (isinstance(self.options, type) and issubclass(self.options, MethodOptions)):
            yield f"options is {self.options!r}, not a class derived from MethodOptions"


METHODS = Registry("groundwalk.fusion_methods", Method)


def method(method_id: str) -> Method:
    """The method of that id; UserError where there is none."""
    return METHODS.find(method_id)


def resolve_options(method_id: str, values: dict[str, Any] | None = None) -> MethodOptions:
    """A method's options from a table of values; UserError for an unknown key or a value out of range."""
    return validated(method(method_id).options, values or {}, f"options of fusion method {method_id}")
