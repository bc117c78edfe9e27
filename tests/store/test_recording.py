"""A recording that can't be written ends in an error; its small images are what they were made of."""

import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from groundwalk.store.images import small_jpeg
from tests.known import there

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


@pytest.mark.parametrize(
    ("width", "suffix"), [(2600, ".jpg"), (700, ".jpg"), (330, ".jpg"), (200, ".jpg"), (1300, ".png")]
)
def test_a_small_image_is_the_image_at_that_size(tmp_path: Path, width: int, suffix: str) -> None:
    """Whatever a JPEG is reduced by when it's decoded."""
    rng = np.random.default_rng(0)
    coarse = rng.integers(0, 255, (9, 12, 3), np.uint8)
    picture = cv2.resize(coarse, (width, 3 * width // 4), interpolation=cv2.INTER_CUBIC)
    cv2.imwrite(str(tmp_path / f"a{suffix}"), picture)
    data = small_jpeg(tmp_path / f"a{suffix}", 320, np.nan, np.nan)
    small = there(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR))
    assert small.shape[1] == min(width, 320)
    expected = cv2.resize(picture, small.shape[1::-1], interpolation=cv2.INTER_AREA)
    assert np.abs(small.astype(float) - expected).mean() < 4
