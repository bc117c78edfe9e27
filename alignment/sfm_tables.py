"""SfM's tables in the order of the frames: poses, focal lengths, and pairs without any model."""

from dataclasses import dataclass

import numpy as np
import pandas as pd

from groundwalk.geometry.poses import Array
from groundwalk.store.choices import PairStatus

# Fewer pairs of a session's frames decide nothing.
_MIN_PAIRS = 8
# Images confirm a focal length where its relative standard error and its error are at most this, the latter also so
# many standard errors.
_CONFIRMED_SD, _CONFIRMED_ERROR, _CONFIRMED_SIGMAS = 0.005, 0.01, 3.0


@dataclass(frozen=True)
class FocalEstimate:
    """A session's focal length by the images of a model, over the captured one, and its standard error."""

    scale: float
    sd: float

    @property
    def is_confirmed(self) -> bool:
        """The images determine it well, and it's the captured one."""
        return self.sd <= _CONFIRMED_SD and abs(self.scale - 1) <= max(_CONFIRMED_ERROR, _CONFIRMED_SIGMAS * self.sd)


@dataclass(frozen=True)
class SfmTables:
    """SfM's tables `images`, in the order of the frames table, `intrinsics`, and `pairs` with the sessions of both."""

    images: pd.DataFrame
    intrinsics: pd.DataFrame
    pairs: pd.DataFrame

    @staticmethod
    def of(frames: pd.DataFrame, images: pd.DataFrame, intrinsics: pd.DataFrame, pairs: pd.DataFrame) -> "SfmTables":
        """From the tables as they are written."""
        session = frames.set_index("frame_id")["session_id"]
        ends = {f"session_{end}": pairs[f"frame_id_{end}"].map(session) for end in "ab"}
        ordered = images.set_index("frame_id").loc[frames["frame_id"]].reset_index()
        # A focal length that no camera logs can't be wrong.
        unstated = set(frames.loc[frames["focal_sd"] > 0, "session_id"])
        intrinsics = intrinsics[~intrinsics["session_id"].isin(unstated)]
        return SfmTables(ordered, intrinsics, pairs.assign(**ends))

    @property
    def registered(self) -> np.ndarray:
        """(N,) frames that SfM has a pose for."""
        return self.images["registered"].to_numpy(bool)

    @property
    def not_registered(self) -> np.ndarray:
        """(N,) why SfM has no pose for a frame, empty where it has."""
        why = self.images["not_registered"]
        reasons = np.where(why.isna(), "SfM didn't register it", "SfM didn't register it: " + why.fillna(""))
        return np.where(self.registered, "", reasons).astype(object)

    def focal(self, model_id: str, session_id: str) -> FocalEstimate | None:
        """None where the images don't determine it."""
        table = self.intrinsics[self.intrinsics["focal_scale_sd"].notna()]
        of_both = table[(table["model_id"] == model_id) & (table["session_id"] == session_id)]
        values = of_both[["focal_scale", "focal_scale_sd"]].to_numpy(float)
        return FocalEstimate(*values[0].tolist()) if len(values) else None

    def pairs_match_vio(self, session_id: str) -> bool:
        """Most pairs of the session's frames, each by its two images alone, move as VIO does."""
        pairs = self.pairs
        within = pairs[(pairs["session_a"] == session_id) & (pairs["session_b"] == session_id)]
        status = within["status"][within["rotation_deg"].notna()]
        consistent = int((status == PairStatus.VERIFIED).sum())
        return consistent >= max(_MIN_PAIRS, int((status == PairStatus.INCONSISTENT_WITH_VIO).sum()) + 1)


def covariances(column: pd.Series) -> Array:
    """A column of 36 doubles or null as (N, 6, 6), NaN where null."""
    rows = [np.full(36, np.nan) if c is None else np.asarray(c, float) for c in column]
    return np.array(rows).reshape(-1, 6, 6)
