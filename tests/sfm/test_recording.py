"""The recording's view of a frame: the points lie on what they are points of, although the lens bends the image."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from groundwalk.geometry.cameras import Camera
from groundwalk.sfm.recording import _log_view, _undistorted
from tests.known import there

_CAMERA = Camera(960, 720, 724.0, 725.0, 484.0, 346.0, (0.092, -0.125, 0.001, 0.0))


class _Stream:
    """What was logged, by path."""

    def __init__(self) -> None:
        self.logged: dict[str, Any] = {}

    def log(self, path: str, what: Any, static: bool = False) -> None:
        self.logged[path] = what


def test_points_lie_on_their_features_in_the_shown_image(tmp_path: Path) -> None:
    ideal = np.array([(-0.6, -0.42), (0.6, -0.4), (-0.58, 0.45), (0.57, 0.46), (0.1, 0.0)])
    seen_px = _CAMERA.project(ideal)
    x, y = np.arange(_CAMERA.width) + 0.5, np.arange(_CAMERA.height)[:, None] + 0.5
    dots = [np.exp(-((x - u) ** 2 + (y - v) ** 2) / 32) for u, v in seen_px]
    cv2.imwrite(str(tmp_path / "dots.png"), 240 * np.sum(dots, axis=0))
    model: Any = SimpleNamespace(
        observed_px=np.vstack([seen_px, [[1.0, 1.0]]]), frame=np.array([0] * 5 + [1]), sfm_T_cam=np.eye(4)[None]
    )
    stream: Any = _Stream()
    _log_view(stream, _undistorted(tmp_path / "dots.png", _CAMERA), _CAMERA, model, 0)

    jpeg = np.array(stream.logged["sfm/camera/image"].blob.as_arrow_array()[0].as_py(), np.uint8)
    image = there(cv2.imdecode(jpeg, cv2.IMREAD_GRAYSCALE)).astype(float)
    assert image.shape == (360, 480)
    shown = np.array(stream.logged["sfm/camera/image/seen"].positions.as_arrow_array().to_pylist())
    assert len(shown) == 5
    for u, v in shown:
        columns, rows = (np.arange(int(c) - 7, int(c) + 8) for c in (u, v))
        window = np.maximum(image[np.ix_(rows, columns)] - 20, 0)
        at = [window.sum(0) @ (columns + 0.5) / window.sum(), window.sum(1) @ (rows + 0.5) / window.sum()]
        assert at == pytest.approx([u, v], abs=0.2)
    # The pinhole that the viewer draws by puts them there, too.
    assert shown == pytest.approx(ideal * [362.0, 362.5] + [242.0, 173.0], abs=1e-3)
