"""What SfM says of its models: where the frames are, of their focal lengths, and of pairs without any model."""

from dataclasses import dataclass

import numpy as np
import pandas as pd

from groundwalk.artefacts.choices import PairStatus

# Fewer pairs of a session's frames say nothing of it.
_FEWEST_PAIRS = 8
# Images confirm a focal length where they tell it to this share, and find no other beyond this or so many sigmas.
_CONFIRMED_SD, _CONFIRMED, _CONFIRMED_SIGMAS = 0.005, 0.01, 3.0


@dataclass(frozen=True)
class Focal:
    """What the images of a model say of a session's captured focal length: its factor to the right one, and sigma."""

    scale: float
    sd: float

    @property
    def confirmed(self) -> bool:
        """The images tell it well, and it's right."""
        return self.sd <= _CONFIRMED_SD and abs(self.scale - 1) <= max(_CONFIRMED, _CONFIRMED_SIGMAS * self.sd)


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
        return SfmTables(ordered, intrinsics, pairs.assign(**ends))

    def focal(self, model_id: str, session_id: str) -> Focal | None:
        """None where the images don't tell."""
        table = self.intrinsics
        rows = table[(table["model_id"] == model_id) & (table["session_id"] == session_id)]
        rows = rows[rows["focal_scale_sd"].notna()]
        return Focal(*rows[["focal_scale", "focal_scale_sd"]].to_numpy(float)[0]) if len(rows) else None

    def belongs(self, session_id: str) -> bool:
        """Most pairs of the session's frames, each by its two images alone, move as VIO does."""
        pairs = self.pairs
        own = pairs[(pairs["session_a"] == session_id) & (pairs["session_b"] == session_id)]
        status = own["status"][own["rotation_deg"].notna()]
        agree = int(np.count_nonzero(status == PairStatus.VERIFIED))
        return agree >= _FEWEST_PAIRS and agree > int(np.count_nonzero(status == PairStatus.INCONSISTENT_WITH_VIO))
