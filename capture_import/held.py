"""A capture that recordings were added to or taken out of, against what an earlier run of import made of it."""

from collections.abc import Mapping

import pandas as pd

from groundwalk.capture_import.settings import ImportSettings
from groundwalk.store import StageRun, UserError
from groundwalk.store.choices import Rejected
from groundwalk.store.schemas import schema
from groundwalk.store.tables import read_table

_SAME_FRAMES = 0.5  # of a recording's, those that another one has, too: then they are one recording
_VIO = ["t_ns", "vio_cam_tx", "vio_cam_ty", "vio_cam_tz"]


def held_frames(r: StageRun[ImportSettings], frames: pd.DataFrame, left_out: Mapping[str, UserError]) -> pd.DataFrame:
    """The frames table with the splits that recordings had; new ones have what the rules say.

    UserError where one that is `left_out` is new, where nothing is new or gone, where a recording that was there is
    imported otherwise now, and where a new one is one that is there, by its images or its VIO.
    """
    assert r.before is not None
    rejects = read_table(r.before / "rejects.parquet", schema("import", "rejects"))
    if new := left_out.keys() - set(rejects.loc[rejects["rejected"] == Rejected.RECORDING, "session_id"]):
        raise left_out[min(new)]
    before = read_table(r.before / "frames.parquet", schema("import", "frames"))
    sessions, known = set(frames["session_id"]), set(before["session_id"])
    if sessions == known:
        raise UserError(
            "the captures hold no other recording than before",
            where=r.data.captures(r.scene.name),
            expected="a recording in a folder of its own",
            do="see what import finds there: groundwalk inspect <folder>",
        )
    columns = ["frame_id", "t_ns", "image_sha256"]
    then, now = (t[t["session_id"].isin(sessions & known)][columns].reset_index(drop=True) for t in (before, frames))
    if not then.equals(now):
        raise UserError(
            "import chooses other frames of the recordings that were there",
            found=f"{len(now)} frames, {len(then)} before",
            expected="the same frames: no change of the captures, of import's settings, or of how densely it samples",
            do="with --refine everything is made anew",
        )
    for session_id in sorted(sessions - known):
        of_session = frames[frames["session_id"] == session_id]
        has_vio = of_session["vio_cam_tx"].notna()
        as_before = of_session["image_sha256"].isin(before["image_sha256"])
        as_before |= has_vio & pd.MultiIndex.from_frame(of_session[_VIO]).isin(pd.MultiIndex.from_frame(before[_VIO]))
        if as_before.mean() > _SAME_FRAMES:
            raise UserError(
                f"{session_id} is a recording that the scene has already",
                found=f"{as_before.sum()} of its {len(of_session)} frames have the image or VIO pose of another",
                do="add another recording",
            )
    if r.holds:
        split = frames["frame_id"].map(before.set_index("frame_id")["split"])
        frames = frames.assign(split=split.fillna(frames["split"]))
    return frames
