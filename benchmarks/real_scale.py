"""The map's scale by what VIO knows nothing of: a printed board in view, and a depth sensor."""

import pandas as pd

from benchmarks.real_figures import Figure, with_sigma
from groundwalk.store.choices import RulerPart

BOARD = "VIO's scale against the board"
BOUNDS = f"{BOARD}, 95 % bounds"
WITHIN_BOUNDS = f"{BOARD}, share of its 95 % bounds"
HELD_OUT = "board's scale against its held-out corners"
HELD_OUT_RMS = "held-out corners, RMS"
DEPTH = "depth by the sensor over the map's"
CONFIDENCES = ("any", "low", "medium", "high")
_SIGMAS = 1.96
# The standard error of a few points isn't known.
_MIN_POINTS = 100


def board_figures(judging: pd.DataFrame, setting: pd.DataFrame) -> list[Figure]:
    """Figures of a board from two align.rulers tables: where it judges the map scaled by VIO, and where it sets the
    scale and half of its corners judge; of several models that of most frames."""
    figures = list[Figure]()
    judging = judging[(judging["part"] == RulerPart.ALL) & judging["vio_scale_error_percent"].notna()]
    for row in judging.nlargest(1, "frames").to_dict("records"):
        error, bounds = row["vio_scale_error_percent"], _SIGMAS * row["vio_scale_sd_percent"]
        figures += [
            Figure("board, frames", row["frames"]),
            Figure(BOARD, error, "%"),
            Figure(BOUNDS, bounds, "%"),
            Figure(WITHIN_BOUNDS, abs(error) / bounds),
            Figure("board's corners, reprojection RMS", row["reprojection_px"], "px"),
            Figure("board's corners, RMS", row["corner_rms_mm"], "mm"),
            Figure("board, flat to", row["flatness_mm"], "mm"),
        ]
    setting = setting[(setting["part"] == RulerPart.HELD_OUT) & setting["used_for_scale"]]
    for row in setting.nlargest(1, "frames").to_dict("records"):
        figures += [
            Figure(HELD_OUT, abs(row["scale_error_percent"]), "%"),
            Figure(HELD_OUT_RMS, row["corner_rms_mm"], "mm"),
        ]
    return figures


def depth_figures(agreement: pd.DataFrame) -> list[Figure]:
    """Median ratios of align.depth_agreement by session, distance from the camera and the sensor's confidence."""
    figures = list[Figure]()
    agreement = agreement[agreement["samples"] >= _MIN_POINTS].astype({"confidence": object})
    for row in agreement.to_dict("records"):
        distance = (
            f"{row['near_m']:g} m or more" if pd.isna(row["far_m"]) else f"{row['near_m']:g} to {row['far_m']:g} m"
        )
        subject = f"{row['session_id']}, {distance}"
        subject += f", model {row['component'] + 1}" if row["component"] else ""
        confidence = CONFIDENCES[0 if pd.isna(row["confidence"]) else 1 + int(row["confidence"])]
        name = f"{DEPTH}, {confidence} confidence"
        figures += with_sigma(name, row["median_ratio"], row["median_ratio_se"], "", subject)
        figures.append(Figure(f"{name}, points", row["samples"], subject=subject))
    return figures
