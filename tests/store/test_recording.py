"""A recording that can't be written ends in an error."""

import subprocess
import sys
from pathlib import Path

import pytest

_FULL = """
import resource, signal, sys
from pathlib import Path
import rerun as rr
import rerun.blueprint as rrb
from groundwalk.store.recording import open_recording
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 12, 1 << 12))
try:
    with open_recording(Path(sys.argv[1]), "fuse", "Church", rrb.Blueprint(rrb.Spatial3DView())) as stream:
        for _ in range(int(sys.argv[2])):
            stream.log("points", rr.Points3D([[0.0, 0.0, 0.0]] * 100_000))
except OSError as error:
    print(error.strerror)
"""


@pytest.mark.parametrize("logged", [0, 10])
def test_a_recording_without_room_ends_in_an_error(tmp_path: Path, logged: int) -> None:
    """Rerun's own sink never comes back where it can't write."""
    ended = subprocess.run(
        [sys.executable, "-c", _FULL, str(tmp_path / "a.rrd"), str(logged)], capture_output=True, text=True, timeout=60
    )
    assert ended.stdout == "File too large\n", ended.stderr
    assert not (tmp_path / "a.rrd").exists()
