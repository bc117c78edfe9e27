"""Retrieval finds frames that see the same landmarks."""

import numpy as np

from groundwalk.sfm.pairs.selection import retrieval_pairs, vlad

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


def test_the_most_similar_frames_of_the_other_walk_are_those_of_the_same_place() -> None:
    images, session = _descriptors(0)
    pairs = retrieval_pairs(vlad(images, 0), session, 3)
    assert (session[pairs[:, 0]] != session[pairs[:, 1]]).all()
    assert np.array_equal(pairs, np.unique(pairs, axis=0))
    assert len(pairs) <= 3 * len(images)
    place = pairs % _FRAMES
    assert np.mean(np.abs(place[:, 0] - place[:, 1]) <= 2) > 0.95
    assert set(pairs.ravel()) == set(range(len(images)))


def test_same_seed_same_descriptors_and_an_image_without_features_is_no_obstacle() -> None:
    images, session = _descriptors(1)
    images[3] = np.empty((0, 0), np.uint8)
    once, again = vlad(images, 5), vlad(images, 5)
    assert np.array_equal(once, again)
    assert np.isfinite(once).all()
    assert np.allclose(np.delete(np.linalg.norm(once, axis=1), 3), 1, atol=1e-5)
    assert len(retrieval_pairs(once, session, 3)) > 0 == len(retrieval_pairs(once, np.zeros(len(images)), 5))
