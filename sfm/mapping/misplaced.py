"""Frames that a mapper put in a wrong place, by their own verified matches.

Incremental mapping can register a few frames that look at one spot by points that those frames triangulated wrongly
among themselves. The reprojection error stays low: matches with other frames, which deny their poses, are left out as
outliers. They are verified matches all the same, and here they count: a pair is violated where the median error of its
matches is far above that of the other pairs. In sound models hardly a pair is.
"""

from dataclasses import dataclass

import numpy as np
import pandas as pd
import pycolmap
from scipy.linalg import LinAlgError

from groundwalk.geometry.poses import Array
from groundwalk.sfm.cameras.adjustment import Cameras
from groundwalk.sfm.cameras.model_adjustment import CameraLog, adjust_model, cameras_of_frames
from groundwalk.sfm.database import Ints, image_id
from groundwalk.sfm.mapping.source import Matches, held_out_check
from groundwalk.sfm.model import pose_of
from groundwalk.sfm.settings import SfmSettings

_MAX_VIOLATED = 0.3  # of a frame's matches, those in violated pairs
# Above both limits a pair is violated: in medians of all pairs, and in pixels, as exact matches have errors of 0.
_TYPICAL_ERRORS, _MIN_VIOLATION_PX = 4.0, 0.25


@dataclass(frozen=True)
class MatchCheck:
    """What a model's frames are held against: matches of all N frames, keypoints of each as extracted, and the log of
    their cameras."""

    matches: Matches
    keypoints: list[Array]
    log: CameraLog
    settings: SfmSettings

    def deregister_misplaced(self, model: pycolmap.Reconstruction) -> list[int]:
        """Deregister the misplaced frames of a model, and return their rows.

        Before the model is adjusted, matches may also contradict a frame that turns quickly, as VIO's angular velocity
        says only about where its rows were seen from. So where frames are contradicted, an adjusted copy decides.
        """
        rows = self._misplaced_rows(model, cameras_of_frames(self.log, []))
        if rows:
            copy = pycolmap.Reconstruction(model)
            try:
                adjusted = adjust_model(copy, self.keypoints, self.log, self.settings)
                rows = self._misplaced_rows(copy, cameras_of_frames(self.log, [adjusted]))
            except LinAlgError as error:
                print(f"misplaced frames by the model as it was mapped: {error}")  # into the log
        for row in rows:
            frame = model.image(image_id(row)).frame
            assert frame is not None
            model.deregister_frame(frame.frame_id)
        return rows

    def _misplaced_rows(self, model: pycolmap.Reconstruction, cameras: Cameras) -> list[int]:
        frames = len(self.log.t_s)
        sfm_T_cam, model_N = np.full((frames, 4, 4), np.nan), np.full(frames, -1)
        for number in model.reg_image_ids():
            sfm_T_cam[number - 1], model_N[number - 1] = pose_of(model.image(number)), 0
        check = held_out_check(self.matches, cameras, sfm_T_cam, model_N)
        return misplaced(check.frames, check.error_px)


def misplaced(frames_M2: Ints, error_px_M: Array) -> list[int]:
    """Rows of frames of which too large a fraction of the matches are in violated pairs, from the frames (M, 2) and
    Sampson distances (M,; px, NaN for none) of matches. The worst goes first, as it violates the pairs of others.

    Where all cameras are off, by a wrong focal length, say, no frame stands out: the limit grows with the errors.
    """
    known = np.isfinite(error_px_M)
    matches = pd.DataFrame({"a": frames_M2[known, 0], "b": frames_M2[known, 1], "error": error_px_M[known]})
    pairs = matches.groupby(["a", "b"])["error"].agg(["median", "count"]).reset_index()
    a, b, count = (pairs[name].to_numpy() for name in ("a", "b", "count"))
    violated = np.where(pairs["median"] > max(_MIN_VIOLATION_PX, _TYPICAL_ERRORS * pairs["median"].median()), count, 0)
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
