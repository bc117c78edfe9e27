"""What a run says at its end."""

from collections.abc import Iterator
from typing import Any


def closing_lines(verdict: dict[str, Any]) -> Iterator[str]:
    """What a run has come to, by its verdict.json: a line each for ground truth, VIO, the structure localiser that
    stands first and the regressor that does, fused where it was."""
    headline, unit = verdict["headline"], verdict["length_unit"]
    small, per_unit = ("cm", 100) if unit == "m" else (unit, 1)
    text = (
        f"{verdict['verdict']}, {100 * headline['trusted_share']:.0f} % of {headline['frames']} frames of class A or B"
    )
    if (sd := headline["position_sd_median"]) is not None:
        text += f", half of them to ± {per_unit * sd:.2g} {small}"
    if (scale_sd := headline["scale_sd"]) is not None:
        text += f"; scale ± {100 * scale_sd:.2g} %"
    if (true := verdict["true_errors"]) is not None:
        stated = f"± {per_unit * true['position_stated']:.2g} {small} are stated with scale and vertical"
        text += f"; {per_unit * true['position']:.2g} {small} from the simulator's truth, where {stated}"
    yield f"ground truth: {text}"
    if drifts := verdict["vio_error_by_distance"]:
        drift = min(drifts, key=lambda row: abs(row["distance_m"] - 5))
        over = f"{drift['median_percent']:.2g} % off over {drift['distance_m']:g} m (median)"
        yield f"VIO: {over}, {headline['vio_jumps']} jumps"
    for kind, fused in (("structure localiser", False), ("regressor", True)):
        known = [row for row in verdict["localisers"] if row["kind"] == kind and row["median_position"] is not None]
        for best in sorted(known, key=lambda row: (row["fused"] != fused, row["median_position"]))[:1]:
            figures = f"median {best['median_position']:g} {unit}, {best['median_rotation_deg']:g}°"
            alone = {row["model"]: row["median_position"] for row in known if best["fused"] and not row["fused"]}
            text = f"; alone {alone[best['model']]:g} {unit}" if best["model"] in alone else ""
            yield f"best {kind}: {best['localiser']}: {figures}, {best['coverage']:g} % have a pose{text}"
