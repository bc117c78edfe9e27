"""Image descriptors: against their definition."""

import numpy as np

from groundwalk.geometry.vlad import aggregate, k_means, nearest_centres


def test_centres_are_means_of_the_points_nearest_to_them() -> None:
    rng = np.random.default_rng(0)
    true = np.array([[0, 0], [10, 0], [0, 10]], np.float32)
    points = (true[rng.integers(0, 3, 300)] + rng.normal(0, 0.1, (300, 2))).astype(np.float32)
    centres = k_means(points, 3, np.random.default_rng(1))
    # Where Lloyd's iterations end, each centre is the mean of the points that are nearest to it.
    means = [points[nearest_centres(points, centres) == word].mean(axis=0) for word in range(3)]
    np.testing.assert_allclose(centres, means, atol=1e-3)
    distance = np.linalg.norm(points[:, None] - centres, axis=2)
    np.testing.assert_array_equal(nearest_centres(points, centres), distance.argmin(axis=1))


def test_a_descriptor_is_the_unit_sum_of_what_each_word_lacks() -> None:
    rng = np.random.default_rng(0)
    centres, points = rng.normal(size=(4, 3)).astype(np.float32), rng.normal(size=(50, 3)).astype(np.float32)
    words = np.zeros((4, 3))
    for point in points:
        word = int(np.linalg.norm(point - centres, axis=1).argmin())
        words[word] += point - centres[word]
    words /= np.linalg.norm(words, axis=1, keepdims=True)
    np.testing.assert_allclose(aggregate(points, centres), words.ravel() / 2, atol=1e-5)
