"""A recording that can't be written ends in an error, at once."""

import subprocess
import sys
from pathlib import Path

_FULL = """
import resource, signal, sys
from pathlib import Path
import rerun.blueprint as rrb
from groundwalk.artefacts.recording import open_recording
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))
try:
    with open_recording(Path(sys.argv[1]), "fuse", "Church", rrb.Blueprint(rrb.Spatial3DView())):
        print("open")
except OSError as error:
    print(error.strerror)
"""


def test_a_disk_without_room_for_a_recording_is_noticed_before_rerun_waits_for_it(tmp_path: Path) -> None:
    """Rerun's sink never comes back where it can't write its first bytes."""
    ended = subprocess.run(
        [sys.executable, "-c", _FULL, str(tmp_path / "a.rrd")], capture_output=True, text=True, timeout=60
    )
    assert ended.stdout == "File too large\n", ended.stderr
    assert not (tmp_path / "a.rrd").exists()
