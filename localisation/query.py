"""One image against a compact map: its pose with covariance, or a refusal with its reason."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from groundwalk.features.sift import Features, sift
from groundwalk.geometry.cameras import Camera
from groundwalk.geometry.poses import Array, skew
from groundwalk.localisation.compact import CompactMap, bytes_by_section, point_covariances, read_map, write_map
from groundwalk.localisation.frames import row_times, with_lens
from groundwalk.localisation.localisers import Grey
from groundwalk.localisation.pose import NO_VERTICAL, Fit, Observed, Priors, ransac, refine
from groundwalk.localisation.results import QueryResult, of_another_size, refused, seen_by
from groundwalk.store.choices import Refusal

Ints = NDArray[np.int64]
Floats = NDArray[np.float32]

_PROBES, _VOTERS = 3, 400
_VIEWS = 12
_VOTE_RATIO, _RATIO = 0.9, 0.9
_RANSAC_PX, _TRIALS = 6.0, 2000
# Shares of the features and of the image's side that an attempt takes. A query shows each point but once, where a
# training frame needs only some of what others show, too: hence more features than of these.
_NEAR_PRIOR, _WHOLE = (0.4, 0.5), (1.5, 1.0)
_SURE_M = 0.02
_GUIDED_PX, _MIN_SIMILARITY = 5.0, 0.6
_INLIER_SIGMAS, _MIN_INLIER_PX, _MAX_INLIER_PX = 4.0, 1.5, 3.0
_MIN_FEATURES, _MIN_MATCHES, _MIN_POSE = 30, 8, 6
# Iterations of refinements whose inliers are still sought, and of the last.
_ROUGHLY, _WELL = 3, 8


def write_localiser(path: Path, localiser: "MapLocaliser") -> None:
    write_map(path, localiser.map)


def read_localiser(path: Path) -> "MapLocaliser":
    """The localiser of a map's file; UserError where that isn't one, or is damaged."""
    return MapLocaliser(read_map(path))


class MapLocaliser:
    """Localises images in a compact map."""

    def __init__(self, content: CompactMap) -> None:
        self.map, self.xyz, self.scene = content, content.xyz, content.scene
        self._seen_by, self._seen_by_bounds = content.views_by_point()
        self._covariance = point_covariances(content)

    def bytes_by_part(self) -> dict[str, int]:
        """The sizes of the file's sections."""
        return bytes_by_section(self.map)

    def localise(
        self, grey: Grey, camera: Camera, gravity: Array | None = None, prior: Array | None = None, *, seed: int = 0
    ) -> QueryResult:
        """The answer for a grey image (H, W) taken with `camera`, as the phone logged it.

        gravity: unit vector (3,), down, in the camera, or None.
        prior: about where the camera is, map_T_cam (4, 4), or None.
        """
        if refusal := of_another_size(grey, camera):
            return refusal
        best: QueryResult | None = None
        # Near a prior a smaller image is enough for most; where the answer isn't sure, the whole one is asked without
        # the prior, which may be what is wrong.
        for attempt in (_NEAR_PRIOR, _WHOLE) if prior is not None else (_WHOLE,):
            features = sift(grey, round(attempt[0] * self.map.max_features), round(attempt[1] * self.map.max_side))
            guess = prior if attempt == _NEAR_PRIOR else None
            answer = self.localise_features(features, camera, gravity, guess, seed=seed)
            if best is None or answer.map_T_cam is not None or best.map_T_cam is None:
                best = answer
            if answer.covariance is not None and np.trace(answer.covariance[3:, 3:]) <= _SURE_M**2:
                break
        assert best is not None
        return best

    def localise_features(
        self,
        features: Features,
        camera: Camera,
        gravity: Array | None = None,
        prior: Array | None = None,
        *,
        seed: int = 0,
        hidden: NDArray[np.bool_] | None = None,
    ) -> QueryResult:
        """The same of an image's features; points that are `hidden` (P,) are taken as not there."""
        if self.map.priors.gravity_sd >= NO_VERTICAL:
            gravity = None
        if len(features) < _MIN_FEATURES:
            return refused(Refusal.FEW_FEATURES, f"{len(features)} features, {_MIN_FEATURES} needed: dark or blurred?")
        camera, readout_s = with_lens(camera, self.map.lenses)
        query, bounds = self.map.projected(features.descriptors), self.map.seen_bounds
        views = self._views_near(prior) if prior is not None else self._views_by_votes(query[:_VOTERS], hidden)
        rows = np.unique(np.concatenate([self.map.seen[bounds[v] : bounds[v + 1]] for v in views.tolist()]))
        rows = rows if hidden is None else rows[~hidden[rows]]
        product = query @ self.map.descriptors[rows].T
        px = features.px.astype(float)
        known = _Query(px, camera.unproject(px), self.xyz[rows], self._covariance[rows], camera, readout_s, gravity)
        matches = _ratio_matches(product)
        matches = matches[np.isfinite(known.ideal[matches[:, 0]]).all(axis=1)]
        count, seen = len(matches), seen_by(px, rows, matches, np.empty((0, 2), np.int64))
        if count < _MIN_MATCHES:
            return refused(Refusal.FEW_MATCHES, f"{count} matches, {_MIN_MATCHES} needed", count, 0, seen)
        max_error = _RANSAC_PX * _scale(camera) / camera.fx
        solution = ransac(known.ideal[matches[:, 0]], known.xyz[matches[:, 1]], max_error, _TRIALS, seed)
        if solution is None or solution[1].sum() < _MIN_POSE:
            return refused(Refusal.NO_POSE, f"no pose explains {_MIN_POSE} of {count} matches", count, 0, seen)
        fit, inliers = self._refined(solution[0], matches[solution[1]], product, known)
        seen, calibration = seen_by(px, rows, matches, inliers), self.map.calibration
        # What the pose itself brought to the keypoints near where it predicts points is no evidence for it.
        agreeing = len(set(map(tuple, matches.tolist())) & set(map(tuple, inliers.tolist())))
        if fit is None or agreeing < calibration.min_inliers:
            reason = f"{agreeing} inliers, {calibration.min_inliers} needed"
            return refused(Refusal.THIN_EVIDENCE, reason, count, agreeing, seen)
        return QueryResult(fit.map_T_cam, calibration.grown(fit.covariance), None, "", count, agreeing, seen)

    def _views_by_votes(self, query: Floats, hidden: NDArray[np.bool_] | None) -> Ints:
        """Training frames that saw most of the points that look like the query's features."""
        content = self.map
        best, second, nearest = (np.full(len(query), -1.0), np.full(len(query), -1.0), np.zeros(len(query), np.int64))
        probes = min(_PROBES, len(content.words))
        word = np.argpartition(-(query @ content.words.T), probes - 1, axis=1)[:, :probes]
        by_word = np.argsort(word.ravel(), kind="stable")
        bounds = np.searchsorted(word.ravel()[by_word], np.arange(len(content.words) + 1))
        by_word //= probes
        for number in range(len(content.words)):
            rows = by_word[bounds[number] : bounds[number + 1]]
            start, end = content.word_bounds[number : number + 2]
            if not len(rows) or start == end:
                continue
            product = query[rows] @ content.descriptors[start:end].T
            at = product.argmax(axis=1)
            top = product[np.arange(len(rows)), at]
            product[np.arange(len(rows)), at] = -1.0
            next_ = np.maximum(product.max(axis=1), np.minimum(top, best[rows]))
            nearest[rows] = np.where(top > best[rows], start + at, nearest[rows])
            second[rows] = np.maximum(second[rows], next_)
            best[rows] = np.maximum(best[rows], top)
        sure = np.flatnonzero(1 - best < _VOTE_RATIO**2 * (1 - second))
        points = np.unique(nearest[sure])
        points = points if hidden is None else points[~hidden[points]]
        # How many of the points each training frame saw.
        counts = self._seen_by_bounds[points + 1] - self._seen_by_bounds[points]
        within = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
        views = self._seen_by[np.repeat(self._seen_by_bounds[points], counts) + within]
        return np.argsort(-np.bincount(views, minlength=len(content.map_T_view)), kind="stable")[:_VIEWS]

    def _views_near(self, map_T_cam: Array) -> Ints:
        """Training frames nearest to a pose: a metre counts as much as 15 degrees."""
        away = np.linalg.norm(self.map.map_T_view[:, :3, 3] - map_T_cam[:3, 3], axis=1)
        cosine = self.map.map_T_view[:, :3, 2] @ map_T_cam[:3, 2]
        turned = np.degrees(np.arccos(np.clip(cosine, -1, 1))) / 15
        return np.argsort(np.hypot(away, turned), kind="stable")[:_VIEWS]

    def _refined(self, map_T_cam: Array, matches: Ints, product: Floats, known: "_Query") -> tuple[Fit | None, Ints]:
        """The refined pose and its inliers (keypoint, point): first of RANSAC's matches, then of all points that it
        predicts near a keypoint that looks alike."""
        priors = self.map.priors
        fit = known.refined(map_T_cam, matches, priors, _ROUGHLY)
        for _ in range(2):
            matches = _guided(fit, known, product)
            if len(matches) < _MIN_POSE:
                return None, matches
            fit = known.refined(fit.map_T_cam, matches, priors, _ROUGHLY)
            scale = _scale(known.camera)
            limit = np.clip(_INLIER_SIGMAS * fit.expected_px, _MIN_INLIER_PX * scale, _MAX_INLIER_PX * scale)
            matches = matches[fit.residual_px < limit]
        if len(matches) < _MIN_POSE:
            return None, matches
        return known.refined(fit.map_T_cam, matches, priors), matches


@dataclass(frozen=True)
class _Query:
    """What is known of a query: K keypoints px (K, 2) and ideal (K, 2), candidate points xyz (C, 3) with covariances
    (C, 3, 3), camera and gravity."""

    px: Array
    ideal: Array
    xyz: Array
    covariance: Array
    camera: Camera
    readout_s: float
    gravity: Array | None

    def refined(self, map_T_cam: Array, matches: Ints, priors: Priors, iterations: int = _WELL) -> Fit:
        """The refined pose of matches (keypoint, point)."""
        keypoint, point = matches.T
        seen = Observed(self.px[keypoint], self.ideal[keypoint], self.xyz[point], self.covariance[point])
        return refine(map_T_cam, seen, self.camera, self.readout_s, priors, self.gravity, iterations)


def _guided(fit: Fit, known: _Query, product: Floats) -> Ints:
    """Keypoints and points (M, 2), one to one, where a point is predicted near a keypoint that looks like it."""
    predicted = _predicted(fit, known.xyz, known.camera, known.readout_s)
    inside = np.flatnonzero(np.isfinite(predicted).all(axis=1))
    if not len(inside):
        return np.empty((0, 2), np.int64)
    reach_px = _GUIDED_PX * _scale(known.camera)
    near, keypoint = cKDTree(known.px).query(predicted[inside], k=4, distance_upper_bound=reach_px)
    point = np.broadcast_to(inside[:, None], keypoint.shape)[np.isfinite(near)]
    keypoint = keypoint[np.isfinite(near)]
    similarity = product[keypoint, point]
    similar = similarity > _MIN_SIMILARITY
    order = np.flatnonzero(similar)[np.argsort(-similarity[similar], kind="stable")]
    keypoint, point = keypoint[order], point[order]
    first_of_keypoint, first_of_point = (np.unique(values, return_index=True)[1] for values in (keypoint, point))
    both = np.intersect1d(first_of_keypoint, first_of_point)
    return np.stack([keypoint[both], point[both]], axis=1)


def _predicted(fit: Fit, xyz: Array, camera: Camera, readout_s: float) -> Array:
    """Where points (P, 3) are in the image (P, 2), NaN outside it."""
    still = (xyz - fit.map_T_cam[:3, 3]) @ fit.map_T_cam[:3, :3]
    px = np.full((len(xyz), 2), np.nan)
    ahead = np.flatnonzero(still[:, 2] > 0.05)
    at = still[ahead, :2] / still[ahead, 2:]
    wide = 1.5 * np.array([camera.width / camera.fx, camera.height / camera.fy])
    ahead, at = ahead[(np.abs(at) < wide).all(axis=1)], at[(np.abs(at) < wide).all(axis=1)]
    image_px = camera.project(at * fit.focal_factor)
    # The row says when a point was exposed; where it was then differs by some pixels, not by many rows.
    time_s = row_times(image_px, camera, readout_s)[:, None]
    cam = still[ahead] - time_s * (fit.velocity + still[ahead] @ skew(fit.angular).T)
    image_px = camera.project(cam[:, :2] / cam[:, 2:] * fit.focal_factor)
    inside = ((image_px >= 0) & (image_px <= [camera.width, camera.height])).all(axis=1)
    px[ahead[inside]] = image_px[inside]
    return px


def _ratio_matches(product: Floats) -> Ints:
    """Keypoint and point (M, 2): of each keypoint the most similar point, where the second is less so by a ratio, and
    of each point the most similar keypoint."""
    if product.shape[1] < 2:
        return np.empty((0, 2), np.int64)
    rows = np.arange(len(product))
    nearest = product.argmax(axis=1)
    best = product[rows, nearest]
    product[rows, nearest] = -1.0
    second = product.max(axis=1)
    product[rows, nearest] = best
    kept = np.flatnonzero(1 - best < _RATIO**2 * (1 - second))
    kept = kept[np.argsort(-best[kept], kind="stable")]
    first = np.unique(nearest[kept], return_index=True)[1]
    kept = np.sort(kept[first])
    return np.stack([kept, nearest[kept]], axis=1)


def _scale(camera: Camera) -> float:
    """Pixels of an image by those of one 640 wide."""
    return max(1.0, max(camera.width, camera.height) / 640)
