"""Which frames have similar images: a descriptor of each image from the scene's own features, nothing to download.

VLAD (Jégou et al., "Aggregating local descriptors into a compact image representation", CVPR 2010) with the
normalisation of each word (Arandjelović and Zisserman, "All about VLAD", CVPR 2013) over words learned from the scene.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from groundwalk.geometry.vlad import aggregate, k_means
from groundwalk.sfm.pairs.candidates import Pairs, unique_pairs

Floats = NDArray[np.float32]
Descriptors = NDArray[np.uint8]

_WORDS, _SAMPLES_PER_WORD = 64, 400
_ROWS_AT_ONCE = 512


def vlad(descriptors: Sequence[Descriptors], seed: int) -> Floats:
    """Unit image descriptors (N, words * D) of N images, each with local descriptors (M, D); zero where M is 0.

    One image at least has local descriptors.
    """
    rng = np.random.default_rng(seed)
    everything = np.concatenate([d for d in descriptors if len(d)])
    sample = np.sort(rng.permutation(len(everything))[: _WORDS * _SAMPLES_PER_WORD])
    centres = k_means(_unit(everything[sample]), _WORDS, rng)
    nothing = np.zeros(centres.size, np.float32)
    return np.stack([aggregate(_unit(d), centres) if len(d) else nothing for d in descriptors])


def retrieval_pairs(image_ND: Floats, session_N: ArrayLike, per_frame: int, within: Pairs | None = None) -> Pairs:
    """Each frame with the `per_frame` most similar frames of other sessions; or of its own, without the pairs `within`
    that are proposed there anyhow."""
    session_N = np.asarray(session_N)
    known = np.empty((2, 0), np.int64) if within is None else np.concatenate([within, within[:, ::-1]]).T
    proposed = [np.empty((0, 2), np.int64)]
    for start in range(0, len(image_ND), _ROWS_AT_ONCE):
        rows = np.arange(start, min(start + _ROWS_AT_ONCE, len(image_ND)))
        similarity = image_ND[rows] @ image_ND.T
        similarity[(session_N[rows, None] == session_N[None]) != (within is not None)] = -np.inf
        similarity[np.arange(len(rows)), rows] = -np.inf
        a, b = known[:, (known[0] >= start) & (known[0] <= rows[-1])]
        similarity[a - start, b] = -np.inf
        best = np.argsort(-similarity, axis=1, kind="stable")[:, :per_frame]
        is_other = np.isfinite(np.take_along_axis(similarity, best, axis=1))
        proposed.append(np.stack([np.broadcast_to(rows[:, None], best.shape)[is_other], best[is_other]], axis=1))
    return unique_pairs(np.concatenate(proposed))


def _unit(descriptors: Descriptors) -> Floats:
    floats = descriptors.astype(np.float32)
    return floats / np.maximum(np.linalg.norm(floats, axis=1, keepdims=True), 1e-12)
