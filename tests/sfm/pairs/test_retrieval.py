"""Retrieval finds frames that see the same landmarks."""

import numpy as np
import pytest

from groundwalk.sfm.extensions import RETRIEVALS
from groundwalk.sfm.pairs.retrieval import pca_vlad, retrieval_pairs, vlad

_LANDMARKS, _SEEN, _FRAMES = 600, 120, 30


def _descriptors(seed: int) -> tuple[list[np.ndarray], np.ndarray]:
    """Two walks along the same street: frame i of each sees the landmarks around its place, noisily."""
    rng = np.random.default_rng(seed)
    landmarks = rng.gamma(0.5, 30, (_LANDMARKS, 128))
    first = np.linspace(0, _LANDMARKS - _SEEN, _FRAMES).astype(int)
    images = [
        np.clip(landmarks[start : start + _SEEN] + rng.normal(0, 8, (_SEEN, 128)), 0, 255).astype(np.uint8)
        for start in np.concatenate([first, first])
    ]
    return images, np.repeat([0, 1], _FRAMES)


@pytest.mark.parametrize("name", RETRIEVALS)
def test_the_most_similar_frames_of_the_other_walk_are_those_of_the_same_place(name: str) -> None:
    images, session = _descriptors(0)
    pairs = retrieval_pairs(RETRIEVALS[name].describe(images, 16, 0), session, 3)
    assert (session[pairs[:, 0]] != session[pairs[:, 1]]).all()
    assert np.array_equal(pairs, np.unique(pairs, axis=0))
    assert len(pairs) <= 3 * len(images)
    place = pairs % _FRAMES
    assert np.mean(np.abs(place[:, 0] - place[:, 1]) <= 2) > 0.95
    assert set(pairs.ravel()) == set(range(len(images)))


@pytest.mark.parametrize("name", RETRIEVALS)
def test_same_seed_same_descriptors_and_an_image_without_features_is_no_obstacle(name: str) -> None:
    images, session = _descriptors(1)
    images[3] = np.empty((0, 0), np.uint8)
    once, again = RETRIEVALS[name].describe(images, 16, 5), RETRIEVALS[name].describe(images, 16, 5)
    assert np.array_equal(once, again)
    assert np.isfinite(once).all()
    assert np.allclose(np.delete(np.linalg.norm(once, axis=1), 3), 1, atol=1e-5)
    assert len(retrieval_pairs(once, session, 3)) > 0


def test_one_session_has_no_pairs_across_sessions() -> None:
    images, _ = _descriptors(2)
    assert len(retrieval_pairs(vlad(images, 8, seed=0), np.zeros(len(images)), 5)) == 0


def test_noise_in_a_few_directions_is_left_out_by_the_principal_components() -> None:
    images, _ = _descriptors(3)
    assert pca_vlad(images, 16, 0).shape == (2 * _FRAMES, 16 * 64)
    # What they keep of the descriptors hardly depends on how these are turned.
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(128, 128)))[0].astype(np.float32)
    unit = [image / np.linalg.norm(image.astype(np.float32), axis=1, keepdims=True) for image in images]
    here, there = (pca_vlad(of, 16, 0) for of in (unit, [image @ turn for image in unit]))
    assert np.allclose(here @ here.T, there @ there.T, atol=0.02)
