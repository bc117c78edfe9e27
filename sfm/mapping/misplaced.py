"""Frames that a mapper put in a wrong place, by their own verified matches.

Incremental mapping can register a few frames that look at one spot by points that those frames triangulated wrongly
among themselves. The reprojection error stays low: matches with other frames, which contradict their poses, are left
out as outliers. They are verified matches all the same, and here they count: a pair is violated where the median error
of its matches is far above that of the other pairs. In sound models hardly a pair is.
"""

import numpy as np
import pandas as pd
import pycolmap

from groundwalk.geometry.poses import Array
from groundwalk.sfm.cameras.adjustment import Adjusted
from groundwalk.sfm.cameras.model_adjustment import CameraLog, Held, adjust_model, cameras_of_frames
from groundwalk.sfm.database import Ints, image_id, pose_of
from groundwalk.sfm.mapping.held_out import Matches, held_out_check
from groundwalk.sfm.settings import SfmSettings

_MAX_VIOLATED = 0.3  # of a frame's matches, those in violated pairs
# Above both limits a pair is violated: in medians of all pairs, and in pixels, as exact matches have errors of 0.
_TYPICAL_ERRORS, _MIN_VIOLATION_PX = 4.0, 0.25


def adjust_without_misplaced(
    model: pycolmap.Reconstruction,
    matches: Matches,
    keypoints: list[Array],
    log: CameraLog,
    settings: SfmSettings,
    held: Held,
) -> tuple[Adjusted, Ints, list[int]]:
    """`adjust_model`, again where frames that aren't held are misplaced: without these, whose rows come back, too."""
    adjusted, rows = adjust_model(model, keypoints, log, settings, held)
    check = check_of(model, matches, log, adjusted, rows)
    misplaced = [row for row in misplaced_frames(check) if image_id(row) not in held.frames]
    for row in misplaced:
        model.deregister_frame(image_id(row))
    if misplaced and set(model.reg_frame_ids()) != held.frames:
        adjusted, rows = adjust_model(model, keypoints, log, settings, held)
    return adjusted, rows, misplaced


def check_of(
    model: pycolmap.Reconstruction, matches: Matches, log: CameraLog, adjusted: Adjusted, rows: Ints
) -> pd.DataFrame:
    """`held_out_check` of an adjusted model, whose frames are `rows`."""
    count = len(log.t_s)
    model_N, sfm_T_cam = np.full(count, -1), np.full((count, 4, 4), np.nan)
    for row in (i - 1 for i in model.reg_image_ids()):
        model_N[row], sfm_T_cam[row] = 0, pose_of(model.image(image_id(row)))
    return held_out_check(matches, cameras_of_frames(log, [(adjusted, rows)]), sfm_T_cam, model_N)


def misplaced_frames(check: pd.DataFrame) -> list[int]:
    """Rows of frames of which too large a fraction of the matches (`held_out.held_out_check`) are in violated pairs.
    The worst goes first, as it violates the pairs of others.

    Where all cameras are off, by a wrong focal length, say, no frame stands out: the limit grows with the errors.
    """
    pairs = check.groupby(["a", "b"])["error_px"].agg(["median", "count"]).reset_index()
    a, b, count = (pairs[name].to_numpy() for name in ("a", "b", "count"))
    limit_px = max(_MIN_VIOLATION_PX, _TYPICAL_ERRORS * pairs["median"].median())
    violated = np.where(pairs["median"] > limit_px, count, 0)
    rows: list[int] = []
    kept = np.ones(len(pairs), bool)
    while kept.any():
        ends = np.concatenate([a[kept], b[kept]])
        of_frame = np.bincount(ends, np.tile(violated[kept], 2)) / np.bincount(ends, np.tile(count[kept], 2)).clip(1)
        worst = int(of_frame.argmax())
        if of_frame[worst] <= _MAX_VIOLATED:
            break
        rows.append(worst)
        kept &= (a != worst) & (b != worst)
    return rows
