"""Which descriptors match, against a literal reading of the rule."""

import numpy as np
from numpy.typing import NDArray

from groundwalk.sfm.pairs.nearest import guided_matches, mutual_matches


def sift_like(rng: np.random.Generator, count: int) -> NDArray[np.float32]:
    """Descriptors (count, 128) as COLMAP keeps them: whole numbers, of length 512."""
    raw = rng.exponential(size=(count, 128))
    return np.round(512 * raw / np.linalg.norm(raw, axis=1, keepdims=True)).astype(np.float32)


def seen_again(rng: np.random.Generator, seen: NDArray[np.float32], noise: float) -> NDArray[np.float32]:
    moved = np.abs(seen + rng.normal(scale=noise, size=seen.shape))
    return np.round(512 * moved / np.linalg.norm(moved, axis=1, keepdims=True)).astype(np.float32)


def literal(a: NDArray[np.float32], b: NDArray[np.float32]) -> list[tuple[int, int]]:
    def angles(one: NDArray[np.float32], others: NDArray[np.float32]) -> list[float]:
        return [float(np.arccos(min(1.0, float(one.astype(int) @ o.astype(int)) / 512**2))) for o in others]

    def best(ones: NDArray[np.float32], others: NDArray[np.float32]) -> dict[int, int]:
        found = {}
        for i, one in enumerate(ones):
            order = sorted(enumerate(angles(one, others)), key=lambda entry: entry[1])
            (j, first), (_, second) = order[0], order[1]
            if first <= 0.7 and first < 0.8 * second:
                found[i] = j
        return found

    forth, back = best(a, b), best(b, a)
    return [(i, j) for i, j in forth.items() if back.get(j) == i]


def test_matches_are_those_of_the_literal_rule() -> None:
    rng = np.random.default_rng(0)
    a = sift_like(rng, 40)
    b = np.concatenate([seen_again(rng, a[::2], 8.0), seen_again(rng, a[::5], 16.0), sift_like(rng, 12)])
    b = b[rng.permutation(len(b))]
    found = [tuple(row) for row in mutual_matches(a, b).tolist()]
    assert found == literal(a, b)
    assert 8 < len(found) < 40


def test_a_descriptor_that_is_there_twice_matches_nothing() -> None:
    rng = np.random.default_rng(2)
    a = sift_like(rng, 6)
    b = np.concatenate([a, a[:1]])
    assert mutual_matches(a, b)[:, 0].tolist() == [1, 2, 3, 4, 5]
    assert mutual_matches(b, a)[:, 1].tolist() == [1, 2, 3, 4, 5]


def test_images_without_features_match_nothing() -> None:
    empty = np.empty((0, 128), np.float32)
    some = sift_like(np.random.default_rng(3), 3)
    assert mutual_matches(empty, some).shape == mutual_matches(some, empty).shape == (0, 2)


def test_of_a_repeated_pattern_what_fits_is_matched() -> None:
    a = sift_like(np.random.default_rng(5), 4)
    b = np.repeat(a, 2, axis=0)  # each feature is seen twice
    assert len(mutual_matches(a, b)) == 0
    found = guided_matches(a, b, lambda i, j: j == 2 * i + 1)
    assert found.tolist() == [[i, 2 * i + 1] for i in range(4)]
    assert len(guided_matches(a, b, lambda i, j: np.zeros(len(i), bool))) == 0
