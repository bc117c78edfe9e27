"""The recording's entities are of one part of one session each."""

from pathlib import Path

import numpy as np
import pandas as pd
from rerun.chunk import RrdReader

from groundwalk.alignment.recording import log_sessions
from groundwalk.alignment.segments import Segment
from groundwalk.alignment.sessions import fit_session
from groundwalk.store.recording import open_recording


def test_a_part_of_a_session_is_not_another_sessions_path(tmp_path: Path) -> None:
    """After its jump `walk` goes on beside the session `walk-2`."""
    poses = np.tile(np.eye(4), (2, 1, 1))
    fits = []
    for session_id, index in (("walk", 1), ("walk-2", 0)):
        segment = Segment(
            session_id=session_id, recording=session_id, index=index, component=0, rows=np.arange(2), t_ns=np.arange(2),
            sfm_T_cam=poses, vio_T_cam=poses, up_cam=np.full((2, 3), np.nan), travelled_m=np.zeros(2),
        )  # fmt: skip
        fits.append(fit_session(segment, poses, np.ones(2, bool), is_metric=False))
    with open_recording(tmp_path / "r.rrd", "align", "Hall", None) as stream:
        log_sessions(stream, fits, pd.DataFrame(), 0.1)
    paths = [str(chunk.entity_path) for chunk in RrdReader(tmp_path / "r.rrd").stream()]
    drawn = {path for path in paths if path.startswith("/map/ground_truth/")}
    assert drawn == {"/map/ground_truth/walk/after_jump_1/path", "/map/ground_truth/walk-2/path"}
