"""The regressors: what a record of one says, and those that there are."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar

from groundwalk.store.registry import Colour, Entry, Registry, callable_faults, colour_faults
from groundwalk.training.regressor_settings import RegressorSettings

if TYPE_CHECKING:
    from groundwalk.training.models.regressor import PoseRegressor


@dataclass(frozen=True, kw_only=True)
class Regressor(Entry):
    """A pose regressor: `make(settings, scenes, outdoor)` is the network with random weights for so many scenes.

    colour: of its poses in recordings. settings: its section [train.regressors.<id>]. multi_scene: one network can hold
    several scenes; others are left out of groups. gives_covariance: its `forward` fills PoseBatch.covariance_B66.
    in_paper: one of the paper's, which are trained where settings name none. whole_image_px: it sees the whole image,
    with so many pixels on the shorter side, of the shape that most training images have, turned upright by the phone's
    gravity; None: a square of [train] crop from its middle.
    """

    noun: ClassVar[str] = "regressor"

    colour: Colour
    settings: type[RegressorSettings]
    make: Callable[[Any, int, bool], "PoseRegressor"] = field(repr=False)
    multi_scene: bool
    gives_covariance: bool
    in_paper: bool = False
    whole_image_px: int | None = None

    def faults(self) -> Iterable[str]:
        yield from super().faults()
        yield from colour_faults(self.colour)
        yield from callable_faults(self, ["make"])
        if not (isinstance(self.settings, type) and issubclass(self.settings, RegressorSettings)):
            yield f"settings is {self.settings!r}, not a class derived from RegressorSettings"


REGRESSORS = Registry("groundwalk.regressors", Regressor)
