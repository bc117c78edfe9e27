"""Normal equations of a bundle adjustment without its points, how they are solved, and what a similarity does to poses.

A pose's errors are a rotation (rad, 3) and a position (sfm units, 3) along the sfm axes: true rotation =
exp(rotation) @ sfm_R_cam, true position = position of sfm_T_cam + position.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_factor, cho_solve, cholesky, lapack
from scipy.sparse import bsr_array, csr_array
from scipy.sparse.linalg import LinearOperator, cg

from groundwalk.geometry.poses import Array, skew
from groundwalk.geometry.rows import summed

# A step is solved to this fraction of its right side, in units of each unknown's own information.
_TOLERANCE, _MAX_ITERATIONS = 1e-4, 40
MAX_FACTORED = 25_000
"""Unknowns of a system whose factor, or inverse, is formed: 5 GB."""
_MAX_UNFACTORED_ITERATIONS = 500
_CHUNK = 64  # frames at once, for memory
_ROWS = 1024  # of a matrix, likewise


@dataclass(frozen=True)
class System:
    """Normal equations over the l N unknowns of N frames and the G that frames share.

    blocks (N, l + s, l + s): J^T J of each frame, by its own l unknowns and those s that it shares, which are `columns`
    (N, s) of G. of_points (l N, 3 P), of_points_shared (G, 3 P): A of the Schur complement A A^T that eliminating the
    points takes away. gradient (l N + G,). point_inverse (P, 3, 3), point_gradient (P, 3): what takes a step back to
    the points. information (l N + G, l N + G): of priors, added to the matrix. gauge (l N, k): H of a stiffness H H^T
    that is added to the part of the frames' unknowns.
    """

    blocks: Array
    columns: NDArray[np.int64]
    of_points: bsr_array
    of_points_shared: Array
    gradient: Array
    point_inverse: Array
    point_gradient: Array
    information: csr_array
    gauge: Array

    @property
    def size(self) -> int:
        """l N, how many unknowns are the frames' own."""
        return int(self.of_points.shape[0])

    @cached_property
    def _of_points_T(self) -> bsr_array:
        return self.of_points.T

    def times(self, x: Array) -> Array:
        """The product of the matrix, which needn't be formed, with a vector (l N + G,)."""
        frames_x, shared = x[: self.size], x[self.size :]
        frames = len(self.blocks)
        local = self.size // frames
        of_frame = np.concatenate([frames_x.reshape(frames, local), shared[self.columns]], axis=1)
        pulled = np.einsum("nij,nj->ni", self.blocks, of_frame)
        by_points = self._of_points_T @ frames_x + shared @ self.of_points_shared
        product = np.zeros(len(x))
        product[: self.size] = pulled[:, :local].ravel() - self.of_points @ by_points
        np.add.at(product[self.size :], self.columns, pulled[:, local:])
        product[self.size :] -= self.of_points_shared @ by_points
        product[: self.size] += self.gauge @ (frames_x @ self.gauge)
        return product + self.information @ x

    def frame_blocks(self) -> Array:
        """The matrix's blocks of each frame's own unknowns (N, l, l), without the gauge."""
        frames, points = len(self.blocks), self.of_points
        local = self.size // frames
        row = np.repeat(np.arange(frames), np.diff(points.indptr))
        eliminated = summed(points.data @ np.swapaxes(points.data, 1, 2), row, frames)
        blocks = self.blocks[:, :local, :local] - eliminated
        entries = self.information.tocoo()
        own = (entries.row // local == entries.col // local) & (entries.row < self.size)
        at_row, at_column = entries.row[own], entries.col[own]
        np.add.at(blocks, (at_row // local, at_row % local, at_column % local), entries.data[own])
        return np.asarray(blocks, float)

    def diagonal(self) -> Array:
        """The matrix's diagonal (l N + G,)."""
        frames, points = len(self.blocks), self.of_points
        local = self.size // frames
        of_blocks = np.diagonal(self.blocks, axis1=1, axis2=2)
        row = np.repeat(np.arange(frames), np.diff(points.indptr))
        eliminated = summed(np.square(points.data).sum(axis=2), row, frames)
        diagonal = np.zeros(len(self.gradient))
        diagonal[: self.size] = (of_blocks[:, :local] - eliminated).ravel()
        np.add.at(diagonal[self.size :], self.columns, of_blocks[:, local:])
        diagonal[self.size :] -= np.square(self.of_points_shared).sum(axis=1)
        diagonal[: self.size] += np.square(self.gauge).sum(axis=1)
        return diagonal + self.information.diagonal()

    def matrix(self) -> Array:
        """The matrix (l N + G, l N + G), in its lower triangle."""
        frames, size, columns = len(self.blocks), self.size, self.columns
        local, total = size // frames, len(self.gradient)
        matrix = np.zeros((total, total))
        for first in range(0, frames, _CHUNK):
            last = min(first + _CHUNK, frames)
            chunk, left = slice(local * first, local * last), slice(local * last)
            before = _rows_of(self.of_points, 0, last).T
            matrix[chunk, left] = self.gauge[chunk] @ self.gauge[left].T
            matrix[chunk, left] -= (_rows_of(self.of_points, first, last) @ before).toarray()
        matrix[size:, :size] = -(self.of_points @ self.of_points_shared.T).T
        matrix[size:, size:] = -self.of_points_shared @ self.of_points_shared.T
        index = np.arange(size).reshape(frames, local)
        matrix[index[:, :, None], index[:, None, :]] += self.blocks[:, :local, :local]
        for k in range(columns.shape[1]):
            rows = size + columns[:, k]
            np.add.at(matrix, (rows[:, None], index), self.blocks[:, local + k, :local])
            for j in range(columns.shape[1]):
                np.add.at(matrix, (rows, size + columns[:, j]), self.blocks[:, local + k, local + j])
        entries = self.information.tocoo()
        matrix[entries.row, entries.col] += entries.data
        return matrix


class Solver:
    """Solves the systems of one adjustment one after the other.

    They differ little, so the factor of one preconditions the next ones' conjugate gradients: a factor takes some
    (l N)^3 operations, a product as many as there are observations. Where conjugate gradients take too many products,
    the system at hand is factorised. One of more than MAX_FACTORED unknowns never is: its frames' blocks precondition
    it (Agarwal et al., "Bundle adjustment in the large", 2010), and a step may stay unfinished.
    """

    def __init__(self) -> None:
        self._factor: tuple[Array, bool] | None = None

    def solve(self, system: System, diagonal: Array, damping: float, right: Array) -> Array:
        """x of (matrix + damping * its diagonal) x = right; raises LinAlgError where that isn't positive definite."""
        unit = 1 / np.sqrt(diagonal)
        shape = (len(right), len(right))
        scaled = LinearOperator(shape, lambda x: unit * system.times(unit * x) + damping * x, dtype=float)
        if len(right) > MAX_FACTORED:
            local, frames = system.size // len(system.blocks), len(system.blocks)
            units = unit[: system.size].reshape(frames, local)
            blocks = units[:, :, None] * system.frame_blocks() * units[:, None, :] + damping * np.eye(local)
            inverses = np.linalg.inv(blocks)

            def by_blocks(x: Array) -> Array:
                of_frames = np.einsum("nij,nj->ni", inverses, x[: system.size].reshape(frames, local))
                return np.concatenate([of_frames.ravel(), x[system.size :]])

            precondition = LinearOperator(shape, by_blocks, dtype=float)
            limits = {"rtol": _TOLERANCE, "maxiter": _MAX_UNFACTORED_ITERATIONS}
            return np.asarray(unit * cg(scaled, unit * right, M=precondition, **limits)[0])
        if self._factor is not None:
            factor = self._factor
            precondition = LinearOperator(shape, lambda x: cho_solve(factor, x / unit) / unit, dtype=float)
            x, unfinished = cg(scaled, unit * right, rtol=_TOLERANCE, maxiter=_MAX_ITERATIONS, M=precondition)
            if not unfinished:
                return np.asarray(unit * x)
        self._factor = None  # two of them don't fit into memory
        matrix = system.matrix()
        matrix[np.diag_indices_from(matrix)] += damping * diagonal
        self._factor = cho_factor(matrix, lower=True, overwrite_a=True)
        return np.asarray(cho_solve(self._factor, right))


def inverse_of(matrix: Array) -> Array:
    """The inverse of a positive definite matrix (n, n) in its lower triangle, which is overwritten; LinAlgError where
    it is singular."""
    triangle = cholesky(matrix, lower=True, overwrite_a=True)
    inverse, info = lapack.dpotri(triangle, lower=True, overwrite_c=True)
    if info:
        raise LinAlgError("the reduced camera system is singular")
    for first in range(0, len(inverse), _ROWS):
        last = min(first + _ROWS, len(inverse))
        corner = np.tril(inverse[first:last, first:last])
        inverse[first:last, first:last] = corner + np.tril(corner, -1).T
        inverse[first:last, last:] = inverse[last:, first:last].T
    return np.asarray(inverse)


def _rows_of(blocks: bsr_array, first: int, last: int) -> bsr_array:
    """The rows of blocks from `first` to before `last`."""
    within = slice(blocks.indptr[first], blocks.indptr[last])
    height = blocks.blocksize[0]
    parts = (blocks.data[within], blocks.indices[within], blocks.indptr[first : last + 1] - within.start)
    return bsr_array(parts, shape=((last - first) * height, blocks.shape[1]))


def block_rows(
    blocks: Array, frame_M: NDArray[np.int64], point_M: NDArray[np.int64], frames: int, points: int
) -> bsr_array:
    """Blocks (M, b, k), one an observation, as a sparse (b frames, k points) matrix of blocks: products of such are
    three times as fast as of single numbers."""
    order = np.lexsort((point_M, frame_M))
    starts = np.concatenate([[0], np.cumsum(np.bincount(frame_M, minlength=frames))])
    shape = (blocks.shape[1] * frames, blocks.shape[2] * points)
    return bsr_array((blocks[order], point_M[order], starts), shape=shape)


def similarities(position_N3: Array) -> Array:
    """What a turn, a shift and a growth of the whole model about its middle do to each pose, (N, 6, 7)."""
    centred = position_N3 - position_N3.mean(axis=0)
    gauge = np.zeros((len(position_N3), 6, 7))
    gauge[:, :3, :3] = np.eye(3)
    gauge[:, 3:, :3] = -skew(centred)
    gauge[:, 3:, 3:6] = np.eye(3)
    gauge[:, 3:, 6] = centred
    return gauge
