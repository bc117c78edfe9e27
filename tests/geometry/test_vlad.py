"""Image descriptors: against their definition."""

import numpy as np

from groundwalk.geometry.vlad import aggregate


def test_a_descriptor_is_the_unit_sum_of_what_each_word_lacks() -> None:
    rng = np.random.default_rng(0)
    centres, points = rng.normal(size=(4, 3)).astype(np.float32), rng.normal(size=(50, 3)).astype(np.float32)
    words = np.zeros((4, 3))
    for point in points:
        word = int(np.linalg.norm(point - centres, axis=1).argmin())
        words[word] += point - centres[word]
    words /= np.linalg.norm(words, axis=1, keepdims=True)
    np.testing.assert_allclose(aggregate(points, centres), words.ravel() / 2, atol=1e-5)
