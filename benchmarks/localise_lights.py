"""What another light does to each localiser: a table and a picture of the figures of benchmarks/localise.py."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure as Picture

from benchmarks.results import markdown_table
from groundwalk.store.choices import Appearance

_LEVELS = ("within 25 cm and 2 deg", "within 500 cm and 10 deg")
_COLUMNS = ("median", "median, rotation", *_LEVELS, "refused", "wrong answers")
_LEFT_OUT = ("Map without gravity", "Map with a prior")
_PICTURE = "localise_lights.png"


@dataclass(frozen=True)
class Figure:
    """One number of a case and localiser."""

    case: str
    localiser: str
    name: str
    value: float
    unit: str


def lights_section(out: Path, figures: Sequence[Figure]) -> Iterator[str]:
    """The section's parts, where several lights were asked; writes its picture into the folder."""
    cases = {light: f"Church, light {light}" for light in Appearance}
    of_light = {light: [f for f in figures if f.case == case] for light, case in cases.items()}
    if sum(map(bool, of_light.values())) < 2:
        return
    localisers = dict.fromkeys(f.localiser for f in of_light[Appearance.SAME] if f.localiser not in _LEFT_OUT)
    values = {(light, f.localiser, f.name): f.value for light, here in of_light.items() for f in here}
    _draw(out / _PICTURE, list(localisers), values)
    yield "## The same walks in other lights"
    yield (
        "Church's test walks; training frames are of light same. Medians in cm and degrees, of all queries; a wrong "
        "answer is off by more than 1 m or 5 degrees."
    )
    yield markdown_table(_rows(list(localisers), values))
    yield f"![Errors by light and localiser]({_PICTURE})"


Values = dict[tuple[Appearance, str, str], float]


def _rows(localisers: Sequence[str], values: Values) -> Iterable[list[str]]:
    yield ["localiser", "light", "median cm", "median deg", *(f"{level}, %" for level in _LEVELS), "refused", "wrong"]
    for localiser in localisers:
        for light in Appearance:
            if (light, localiser, "median") in values:
                yield [localiser, light, *(f"{values[light, localiser, name]:.3g}" for name in _COLUMNS)]


def _draw(path: Path, localisers: Sequence[str], values: Values) -> None:
    """Median position error and share within the finest level, by light."""
    picture = Picture(figsize=(9, 3.2), layout="constrained")
    axes = picture.subplots(1, 2)
    for localiser in localisers:
        for axis, name in zip(axes, ("median", _LEVELS[0]), strict=True):
            drawn = [values.get((light, localiser, name), np.nan) for light in Appearance]
            axis.plot(list(map(str, Appearance)), drawn, marker="o", label=localiser)
    axes[0].set_yscale("log")
    axes[0].set_ylabel("median position error, cm")
    axes[1].set_ylabel(f"{_LEVELS[0]}, %")
    axes[1].set_ylim(-3, 103)
    for axis in axes:
        axis.spines[["top", "right"]].set_visible(False)
    axes[1].legend(frameon=False, fontsize=8)
    picture.savefig(path, dpi=110)
