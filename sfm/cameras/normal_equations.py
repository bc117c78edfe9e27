"""Normal equations of a bundle adjustment without its points, how they are solved, and what a similarity does to poses.

A pose's errors are a rotation (rad, 3) and a position (sfm units, 3) along the sfm axes: true rotation =
exp(rotation) @ sfm_R_cam, true position = position of sfm_T_cam + position.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_factor, cho_solve, cholesky, lapack, pinvh
from scipy.sparse import block_diag, bsr_array, csr_array, diags_array, eye_array
from scipy.sparse.linalg import LinearOperator, cg

from groundwalk.geometry.poses import Array, skew
from groundwalk.geometry.rows import summed
from groundwalk.store.cores import usable_cores
from groundwalk.store.parallel import in_parallel

# A step is solved to this fraction of its right side, in units of each unknown's own information.
_TOLERANCE, _MAX_ITERATIONS = 1e-4, 40
MAX_FACTORED = 12_000
"""Unknowns of a system whose factor, or inverse, is formed: 1.2 GB."""
# Where no factor is formed: the same for an adjustment's steps, for products with the inverse, and the iterations.
_STEP_TOLERANCE, _MAX_STEP_ITERATIONS = 1e-2, 500
_FEW_STEP_ITERATIONS = 100  # within which a step is solved by an earlier one's factors, or else by its own
_PRODUCT_TOLERANCE, _MAX_PRODUCT_ITERATIONS = 1e-3, 1500
_CLUSTER = 64  # frames, at most, of which one factor is formed
_CHUNK = 64  # frames at once, for memory
_ROWS, _POINTS = 1024, 8192  # of a matrix, and points, likewise
_BLOCKS_A_PART = 1 << 15  # at least, for a core


@dataclass(frozen=True)
class System:
    """Normal equations over the l N unknowns of N frames and the G that frames share.

    blocks (N, l + s, l + s): J^T J of each frame, by its own l unknowns and those s that it shares, which are `columns`
    (N, s) of G. of_points (l N, 3 P), of_points_shared (G, 3 P): A of the Schur complement A A^T that eliminating the
    points takes away. gradient (l N + G,). point_root (P, 3, 3): R of the inverse R^T R of each point's J^T J, and
    point_gradient (P, 3): what takes a step back to the points. information (l N + G, l N + G): of priors, added to the
    matrix. gauge (l N, k): H of a stiffness H H^T that is added to the part of the frames' unknowns. position (N, 3):
    of the frames. held (H,): frames that stay where they are, whose unknowns are tied to no others.
    """

    blocks: Array
    columns: NDArray[np.int64]
    of_points: bsr_array
    of_points_shared: Array
    gradient: Array
    point_root: Array
    point_gradient: Array
    information: csr_array
    gauge: Array
    position: Array
    held: NDArray[np.int64]

    @cached_property
    def free(self) -> NDArray[np.int64]:
        """The unknowns that aren't of held frames."""
        number = np.arange(len(self.gradient))
        return np.flatnonzero((number >= self.size) | ~np.isin(number // (self.size // len(self.blocks)), self.held))

    @property  # not kept: a system that referred to itself would stay in memory
    def of_free(self) -> "System":
        """The system of the free unknowns."""
        if not len(self.held):
            return self
        frames, free = np.setdiff1d(np.arange(len(self.blocks)), self.held), self.free
        return replace(
            self,
            blocks=self.blocks[frames],
            columns=self.columns[frames],
            of_points=_rows_of(self.of_points, frames),
            gradient=self.gradient[free],
            information=self.information[free][:, free],
            gauge=self.gauge[free[free < self.size]],
            position=self.position[frames],
            held=self.held[:0],
        )

    def with_held(self, of_free: Array) -> Array:
        """A vector of all unknowns by that of the free ones; 0 of others."""
        every = np.zeros(len(self.gradient))
        every[self.free] = of_free
        return every

    @property
    def size(self) -> int:
        """l N, how many unknowns are the frames' own."""
        return int(self.of_points.shape[0])

    @property
    def point_inverse(self) -> Array:
        """The inverse (P, 3, 3) of each point's J^T J."""
        return np.asarray(np.swapaxes(self.point_root, 1, 2) @ self.point_root)

    def point_step(self, step: Array) -> Array:
        """How the points move (P, 3) with a step (l N + G,) of the other unknowns."""
        moved = _product(self._parts[1], step[: self.size, None])[:, 0] + self.of_points_shared.T @ step[self.size :]
        pull = np.einsum("pij,pj->pi", self.point_root, self.point_gradient) + moved.reshape(-1, 3)
        return -np.einsum("pji,pj->pi", self.point_root, pull)

    @cached_property
    def _of_points_T(self) -> bsr_array:
        return self.of_points.T

    @cached_property
    def _parts(self) -> tuple[list[bsr_array], list[bsr_array]]:
        """`of_points` and its transpose, in rows for each core."""
        return _in_parts(self.of_points), _in_parts(self._of_points_T)

    def times(self, x: Array) -> Array:
        """The product of the matrix, which needn't be formed, with a vector (l N + G,) or with columns (l N + G, k)."""
        columns = x.reshape(len(x), -1)
        of_points, of_points_T = self._parts
        frames_x, shared = columns[: self.size], columns[self.size :]
        frames = len(self.blocks)
        local = self.size // frames
        pulled = self.blocks @ np.concatenate([frames_x.reshape(frames, local, -1), shared[self.columns]], axis=1)
        by_points = _product(of_points_T, frames_x) + self.of_points_shared.T @ shared
        product = self.information @ columns
        product[: self.size] += pulled[:, :local].reshape(self.size, -1) - _product(of_points, by_points)
        product[: self.size] += self.gauge @ (self.gauge.T @ frames_x)
        np.add.at(product[self.size :], self.columns, pulled[:, local:])
        product[self.size :] -= self.of_points_shared @ by_points
        return np.asarray(product.reshape(x.shape))

    def restricted(self, motions: bsr_array) -> Array:
        """x^T matrix x (k + G, k + G), where x is `motions` (l N, k), blocks of all frames' unknowns, and the unknowns
        that frames share."""
        frames, points, k = len(self.blocks), len(self.point_root), motions.shape[1]
        x = block_diag([motions, eye_array(len(self.gradient) - self.size)], format="csr")
        of_frames = np.concatenate([np.arange(self.size).reshape(frames, -1), self.size + self.columns], axis=1)
        blocks, x_of_frames = bsr_array((self.blocks, np.arange(frames), np.arange(frames + 1))), x[of_frames.ravel()]
        product = (x_of_frames.T @ (blocks @ x_of_frames) + x.T @ (self.information @ x)).toarray()
        by_gauge = self.gauge.T @ motions
        product[:k, :k] += by_gauge.T @ by_gauge
        for first in range(0, points, _POINTS):
            rows = np.arange(first, min(first + _POINTS, points))
            pulled = _rows_of(self._of_points_T, rows) @ motions
            of_shared = self.of_points_shared[:, 3 * first : 3 * first + 3 * len(rows)]
            with_shared = of_shared @ pulled
            product[:k, :k] -= (pulled.T @ pulled).toarray()
            product[k:, :k] -= with_shared
            product[:k, k:] -= with_shared.T
            product[k:, k:] -= of_shared @ of_shared.T
        return np.asarray(product)

    def part(self, frames: NDArray[np.int64]) -> Array:
        """The matrix (l n, l n) of n frames' own unknowns."""
        local = self.size // len(self.blocks)
        index = (local * frames[:, None] + np.arange(local)).ravel()
        of_points = _rows_of(self.of_points, frames)
        matrix = self.information[index][:, index].toarray() + self.gauge[index] @ self.gauge[index].T
        matrix -= (of_points @ of_points.T).toarray()
        for k, frame in enumerate(frames.tolist()):
            own = slice(local * k, local * (k + 1))
            matrix[own, own] += self.blocks[frame, :local, :local]
        return matrix

    def diagonal(self) -> Array:
        """The matrix's diagonal (l N + G,)."""
        frames, points = len(self.blocks), self.of_points
        local = self.size // frames
        of_blocks = np.diagonal(self.blocks, axis1=1, axis2=2)
        row = np.repeat(np.arange(frames), np.diff(points.indptr))
        eliminated = summed(np.einsum("mij,mij->mi", points.data, points.data), row, frames)
        diagonal = np.zeros(len(self.gradient))
        diagonal[: self.size] = (of_blocks[:, :local] - eliminated).ravel()
        np.add.at(diagonal[self.size :], self.columns, of_blocks[:, local:])
        diagonal[self.size :] -= np.einsum("gp,gp->g", self.of_points_shared, self.of_points_shared)
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
            before = _rows_of(self.of_points, np.arange(last)).T
            matrix[chunk, left] = self.gauge[chunk] @ self.gauge[left].T
            matrix[chunk, left] -= (_rows_of(self.of_points, np.arange(first, last)) @ before).toarray()
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
    the system at hand is factorised. Of one of more than MAX_FACTORED unknowns only clusters of frames are
    (`Preconditioner`), and a step may stay unfinished.
    """

    def __init__(self) -> None:
        self._factor: tuple[Array, bool] | None = None
        self._preconditioner: Preconditioner | None = None

    def solve(self, system: System, diagonal: Array, damping: float, right: Array) -> Array:
        """x of (matrix + damping * its diagonal) x = right, 0 of what is held; LinAlgError where the matrix isn't
        positive definite."""
        return system.with_held(self._solve(system.of_free, diagonal[system.free], damping, right[system.free]))

    def _solve(self, system: System, diagonal: Array, damping: float, right: Array) -> Array:
        unit = 1 / np.sqrt(diagonal)
        shape = (len(right), len(right))
        scaled = LinearOperator(shape, lambda x: unit * system.times(unit * x) + damping * x, dtype=float)
        if len(right) > MAX_FACTORED:
            if self._preconditioner is not None:
                known = IterativeSolver(system, diagonal, damping, self._preconditioner)
                x, has_converged = known.solve(right, _STEP_TOLERANCE, _FEW_STEP_ITERATIONS)
                if has_converged:
                    return x
            self._preconditioner = None
            solver = IterativeSolver(system, diagonal, damping)
            self._preconditioner = solver.preconditioner
            return solver.solve(right, _STEP_TOLERANCE, _MAX_STEP_ITERATIONS)[0]
        if self._factor is not None:
            factor = self._factor
            precondition = LinearOperator(
                shape, lambda x: cho_solve(factor, x / unit, check_finite=False) / unit, dtype=float
            )
            x, unfinished = cg(scaled, unit * right, rtol=_TOLERANCE, maxiter=_MAX_ITERATIONS, M=precondition)
            if not unfinished:
                return np.asarray(unit * x)
        self._factor = None  # two of them don't fit into memory
        matrix = system.matrix()
        matrix[np.diag_indices_from(matrix)] += damping * diagonal
        self._factor = cho_factor(matrix.T, overwrite_a=True)  # transposed, for LAPACK's order: not copied
        return np.asarray(cho_solve(self._factor, right))


class Preconditioner:
    """About the inverse of a system's matrix + `damped` (l N + G,) on its diagonal, on two levels: clusters of
    neighbouring frames by their factors, and how the clusters as a whole turn, shift and grow, with the unknowns that
    all share, by a small matrix (Kushal and Agarwal, "Visibility based preconditioning for bundle adjustment", 2012;
    Nicolaides, "Deflation of conjugate gradients", 1987). The first alone takes many steps to bend a long walk.
    """

    def __init__(self, system: System, damped: Array) -> None:
        frames, total = len(system.blocks), len(damped)
        self._size = system.size
        local = self._size // frames
        clusters = _clusters(system.position)
        self._index = [(local * members[:, None] + np.arange(local)).ravel() for members in clusters]
        self._factors = [
            cho_factor(system.part(members) + np.diag(damped[index]), lower=True, overwrite_a=True)
            for members, index in zip(clusters, self._index, strict=True)
        ]
        of_frame = np.zeros((frames, local, 7))
        cluster = np.empty(frames, np.int64)
        for k, members in enumerate(clusters):
            cluster[members] = k
            of_frame[members, :6] = similarities(system.position[members])
        shape = (self._size, 7 * len(clusters))
        motions = bsr_array((of_frame, cluster, np.arange(frames + 1)), shape=shape)
        self._motions = block_diag([motions, eye_array(total - self._size)], format="csr")
        of_damped = (self._motions.T @ (diags_array(damped) @ self._motions)).toarray()
        self._coarse = pinvh(system.restricted(motions) + of_damped)

    def variances(self) -> Array:
        """The inverse's diagonal (l N,) of the frames' unknowns, as far as their clusters tell, with the other frames
        held. Of what is a frame's own, as its angular velocity, that is nearly all; of others it's too small."""
        found = np.zeros(self._size)
        for index, factor in zip(self._index, self._factors, strict=True):
            found[index] = np.diag(cho_solve(factor, np.eye(len(index))))
        return found

    def times(self, right: Array) -> Array:
        """The product with columns (l N + G, k)."""
        x = self._motions @ (self._coarse @ (self._motions.T @ right))
        for index, factor in zip(self._index, self._factors, strict=True):
            x[index] += cho_solve(factor, right[index], check_finite=False)
        return np.asarray(x)


class IterativeSolver:
    """Solves (matrix + damping * its diagonal) x = right without forming the matrix, by conjugate gradients with the
    preconditioner of this system, or that of one that differs little."""

    def __init__(
        self, system: System, diagonal: Array, damping: float, preconditioner: Preconditioner | None = None
    ) -> None:
        self._system, self._damped, self._unit = system, damping * diagonal, 1 / np.sqrt(diagonal)
        self.preconditioner = preconditioner or Preconditioner(system, self._damped)

    def solve(
        self, right: Array, tolerance: float = _PRODUCT_TOLERANCE, iterations: int = _MAX_PRODUCT_ITERATIONS
    ) -> tuple[Array, bool]:
        """x (l N + G,) or (l N + G, k), and whether it came to the tolerance within as many iterations as are taken at
        most: the residual, in units of each unknown's own information, over that of `right`.

        All columns move along all directions, which takes far fewer of them (Dubrulle, "Retooling the method of block
        conjugate gradients", 2001): residual = basis @ size, with basis^T preconditioner basis = 1.
        """
        columns = right.reshape(len(right), -1)
        x, limit = np.zeros_like(columns), tolerance * self._norm(columns)
        basis, preconditioned, size = self._orthonormal(columns)
        direction = preconditioned
        for _ in range(iterations):
            if (self._norm(basis @ size) <= limit).all():
                return x.reshape(right.shape), True
            pulled = self._times(direction)
            length = pinvh(direction.T @ pulled)
            x += direction @ (length @ size)
            basis, preconditioned, change = self._orthonormal(basis - pulled @ length)
            direction, size = preconditioned + direction @ change.T, change @ size
        return x.reshape(right.shape), False

    def _orthonormal(self, columns: Array) -> tuple[Array, Array, Array]:
        """Q (l N + G, r), what the preconditioner makes of it, and S (r, k) with Q S the k columns, as far as these are
        independent, and Q^T preconditioner Q = 1."""
        preconditioned = self.preconditioner.times(columns)
        values, vectors = np.linalg.eigh(columns.T @ preconditioned)
        kept = values > len(values) * np.finfo(float).eps * max(values[-1], np.finfo(float).tiny)
        root = np.sqrt(values[kept])
        inverse = vectors[:, kept] / root
        return columns @ inverse, preconditioned @ inverse, root[:, None] * vectors[:, kept].T

    def inverse_times(self, right: Array) -> Array:
        """The inverse's product with a vector (l N + G,) or with columns (l N + G, k); LinAlgError where it takes too
        many iterations."""
        x, has_converged = self.solve(right)
        if not has_converged:
            raise LinAlgError("conjugate gradients don't converge")
        return x

    def _norm(self, residual: Array) -> Array:
        return np.asarray(np.linalg.norm(self._unit[:, None] * residual, axis=0))

    def _times(self, x: Array) -> Array:
        return self._system.times(x) + self._damped[:, None] * x


def inverse_of(matrix: Array) -> Array:
    """The inverse of a positive definite matrix (n, n) in its lower triangle, which is overwritten; LinAlgError where
    it is singular."""
    # Transposed, it is in LAPACK's order, and isn't copied.
    triangle = cholesky(matrix.T, overwrite_a=True)
    upper, info = lapack.dpotri(triangle, overwrite_c=True)
    if info:
        raise LinAlgError("the reduced camera system is singular")
    inverse = upper.T
    for first in range(0, len(inverse), _ROWS):
        last = min(first + _ROWS, len(inverse))
        corner = np.tril(inverse[first:last, first:last])
        inverse[first:last, first:last] = corner + np.tril(corner, -1).T
        inverse[first:last, last:] = inverse[last:, first:last].T
    return np.asarray(inverse)


def _rows_of(blocks: bsr_array, rows: NDArray[np.int64]) -> bsr_array:
    """Some rows of blocks."""
    counts = np.diff(blocks.indptr)[rows]
    bounds = np.concatenate([[0], np.cumsum(counts)])
    within = np.repeat(blocks.indptr[rows] - bounds[:-1], counts) + np.arange(bounds[-1])
    shape = (len(rows) * blocks.blocksize[0], blocks.shape[1])
    return bsr_array((blocks.data[within], blocks.indices[within], bounds), shape=shape)


def _in_parts(blocks: bsr_array) -> list[bsr_array]:
    """The same in some rows for each core, without copies."""
    data, indices, indptr = blocks.data, blocks.indices, blocks.indptr
    parts = max(1, min(usable_cores(), len(indices) // _BLOCKS_A_PART))
    bounds = np.searchsorted(indptr, np.linspace(0, indptr[-1], parts + 1)).tolist()
    bounds[-1] = len(indptr) - 1
    height, width = blocks.blocksize[0], blocks.shape[1]
    return [
        bsr_array(
            (data[indptr[a] : indptr[b]], indices[indptr[a] : indptr[b]], indptr[a : b + 1] - indptr[a]),
            shape=(height * (b - a), width),
        )
        for a, b in pairwise(bounds)
    ]


def _product(parts: list[bsr_array], x: Array) -> Array:
    if len(parts) == 1:
        return np.asarray(parts[0] @ x)
    return np.concatenate(list(in_parallel(lambda part: part @ x, parts)))


def _clusters(position_N3: Array) -> list[NDArray[np.int64]]:
    """Frames in clusters of neighbours, halved along their longest extent until few are left."""
    whole, clusters = [np.arange(len(position_N3))], []
    while whole:
        members = whole.pop()
        position = position_N3[members]
        if len(members) > _CLUSTER:
            order = np.argsort(position[:, np.argmax(np.ptp(position, axis=0))], kind="stable")
            whole += np.array_split(members[order], 2)
        else:
            clusters.append(np.sort(members))
    return clusters


def block_rows(
    blocks: Array, frame_M: NDArray[np.int64], point_M: NDArray[np.int64], frames: int, points: int
) -> bsr_array:
    """Blocks (M, b, k), one an observation and in the order of their frames, as a sparse (b frames, k points) matrix of
    blocks: products of such are three times as fast as of single numbers."""
    starts = np.concatenate([[0], np.cumsum(np.bincount(frame_M, minlength=frames))])
    shape = (blocks.shape[1] * frames, blocks.shape[2] * points)
    return bsr_array((blocks, point_M, starts), shape=shape)


def similarities(position_N3: Array) -> Array:
    """What a turn, a shift and a growth of the whole model about its middle do to each pose, (N, 6, 7)."""
    centred = position_N3 - position_N3.mean(axis=0)
    gauge = np.zeros((len(position_N3), 6, 7))
    gauge[:, :3, :3] = np.eye(3)
    gauge[:, 3:, :3] = -skew(centred)
    gauge[:, 3:, 3:6] = np.eye(3)
    gauge[:, 3:, 6] = centred
    return gauge
