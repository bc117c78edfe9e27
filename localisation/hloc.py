"""The baseline HLoc (Sarlin et al., "From coarse to fine", CVPR 2019): retrieval, matching with each image, PnP.

All training images' features are kept; a query is matched with the images that look most alike, 2D to 2D, its 3D points
are those of their tracks, and COLMAP's LO-RANSAC with refinement gives the pose and its covariance, which grows as held
out training frames ask for; where no more keypoints agree than by chance there is none. The features are SIFT's, or
those of networks, which networks match.
"""

from dataclasses import replace

import numpy as np
import pycolmap
from numpy.typing import NDArray

from groundwalk.features.sift import Features
from groundwalk.geometry.cameras import Camera
from groundwalk.geometry.poses import Array, inverse, make_pose, skew
from groundwalk.geometry.vlad import aggregate, k_means
from groundwalk.localisation.calibration import UNCALIBRATED, Trial, calibrated
from groundwalk.localisation.entries import HLocSettings
from groundwalk.localisation.frames import with_lens
from groundwalk.localisation.localisers import Grey, Size
from groundwalk.localisation.matching import unit
from groundwalk.localisation.prepared import MIN_POINTS, Prepared, Track, untracked
from groundwalk.localisation.results import QueryResult, of_another_size, refused, seen_by
from groundwalk.localisation.tracks import Points
from groundwalk.store.choices import Refusal

_WORDS, _SAMPLES = 64, 25_600
_MAX_PX, _MIN_MATCHES = 12.0, 4
_SURE_INLIERS = 30  # with fewer a covariance is not stated: corridors gave 21 to poses that were 14 m off
_HELD_OUT = 24  # training frames, at most, that say what covariances are worth


class HLocLocaliser:
    """HLoc of a scene's training frames."""

    def __init__(self, prepared: Prepared, settings: HLocSettings, track: Track = untracked) -> None:
        self.lenses, self.settings, self.kind = prepared.lenses, settings, prepared.kind
        self.extraction, features = prepared.settings, prepared.training.features
        self._features = [replace(f, descriptors=unit(f.descriptors)) for f in features]
        self._sizes = [(camera.width, camera.height) for camera in prepared.training.logged]
        self._descriptor_bytes = features[0].descriptors[:1].nbytes
        every = np.concatenate([f.descriptors for f in self._features])
        rng = np.random.default_rng(0)
        self._words = k_means(every[np.sort(rng.permutation(len(every))[:_SAMPLES])], _WORDS, rng)
        described = track(self._features, "HLoc: describing images", len(features))
        self._images = np.stack([aggregate(f.descriptors, self._words) for f in described])
        self._first = np.cumsum([0, *(len(f) for f in features)])
        self._calibrate(prepared, track)

    def _calibrate(self, prepared: Prepared, track: Track) -> None:
        """By answers for training frames that are left out, as all that hangs on them is: covariances, and how many
        inliers an answer has by chance, where it is only asked of images that share no point with it."""
        training, every = prepared.training, np.arange(len(self._features))
        point, view = prepared.points.point, prepared.rays.view[prepared.points.feature]
        held = np.unique(np.linspace(0, len(every) - 1, min(_HELD_OUT, len(every) // 2), dtype=int))
        others, trials = np.setdiff1d(every, held), list[Trial]()
        self._calibration = UNCALIBRATED
        self._answer_by(prepared.points_of(~np.isin(every, held)))
        if len(self.xyz) >= MIN_POINTS:
            for row in track(held.tolist(), "HLoc: calibrating by held-out training frames", len(held)):
                asked = training.features[row], training.logged[row]
                answer = self.localise_features(*asked, among=others)
                apart = np.setdiff1d(others, view[np.isin(point, point[view == row])])
                by_chance = self.localise_features(*asked, among=apart).inliers
                trials.append(Trial(answer, training.views.map_T_cam[row], by_chance))
        found = calibrated(trials)
        self._calibration = replace(found, min_inliers=max(found.min_inliers, _SURE_INLIERS))
        self._answer_by(prepared.points)

    def _answer_by(self, points: Points) -> None:
        self.xyz = points.xyz
        """The points (P, 3) of the training frames' tracks."""
        self._point = np.full(self._first[-1], -1)
        self._point[points.feature] = points.point

    def bytes_by_part(self) -> dict[str, int]:
        """What a query needs, in bytes: keypoints as two floats, descriptors as they are, image descriptors as floats,
        points as three floats, and the point of each keypoint."""
        count = len(self._point)
        return {
            "keypoints": 8 * count,
            "descriptors": self._descriptor_bytes * count,
            "image descriptors": self._images.nbytes + self._words.nbytes,
            "points": 12 * len(self.xyz),
            "tracks": 4 * count,
        }

    def localise(
        self, grey: Grey, camera: Camera, gravity: Array | None = None, prior: Array | None = None, *, seed: int = 0
    ) -> QueryResult:
        """The answer for a grey image (H, W) taken with `camera` as the phone logged it. Gravity and a prior
        aren't used."""
        if refusal := of_another_size(grey, camera):
            return refusal
        features = self.kind.extract(grey, self.extraction.max_features, self.extraction.max_side)
        return self.localise_features(features, camera, seed=seed)

    def localise_features(
        self, features: Features, camera: Camera, *, seed: int = 0, among: NDArray[np.int64] | None = None
    ) -> QueryResult:
        """The same of an image's features, matched with training images `among` these (V,), or with any."""
        camera, _ = with_lens(camera, self.lenses)
        if not len(features):
            return refused(Refusal.FEW_FEATURES, "no features: dark or blurred?")
        query = replace(features, descriptors=unit(features.descriptors))
        among = np.arange(len(self._images)) if among is None else among
        similarity = self._images[among] @ aggregate(query.descriptors, self._words)
        size: Size = (camera.width, camera.height)
        matches = [np.empty((0, 2), np.int64)]  # keypoints of the query and points by matches with an image
        for view in among[np.argsort(-similarity, kind="stable")[: self.settings.retrieved]].tolist():
            rows = self.kind.match(query, self._features[view], size, self._sizes[view])
            point = self._point[self._first[view] + rows[:, 1]]
            matches.append(np.stack([rows[:, 0], point], axis=1)[point >= 0])
        pairs = np.unique(np.concatenate(matches), axis=0)
        px, pose = features.px.astype(float), None
        if len(pairs) >= _MIN_MATCHES:
            pose = absolute_pose(px[pairs[:, 0]], self.xyz[pairs[:, 1]], camera, seed)
        inlier = np.zeros(len(pairs), bool) if pose is None else pose[2]
        seen, needed = seen_by(px, np.arange(len(self.xyz)), pairs, pairs[inlier]), self.settings.min_inliers
        count = int(inlier.sum())
        if pose is None or count < needed:
            return refused(Refusal.THIN_EVIDENCE, f"{count} inliers, {needed} needed", len(pairs), count, seen)
        # As few inliers as an image of another place has say nothing of how far off the pose is.
        is_sure = count >= self._calibration.min_inliers
        covariance = self._calibration.grown(pose[1]) if is_sure else None
        return QueryResult(pose[0], covariance, None, "", len(pairs), count, seen)


def absolute_pose(px: Array, xyz: Array, camera: Camera, seed: int) -> tuple[Array, Array, NDArray[np.bool_]] | None:
    """map_T_cam (4, 4) by keypoints px (M, 2) and points xyz (M, 3) in the map, its covariance (6, 6) of (rotation,
    position) in the map's axes for keypoints that are off by a pixel, and which are inliers (M,); None without a
    pose."""
    coefficients = np.zeros(8)
    coefficients[: len(camera.distortion)] = camera.distortion
    params = [camera.fx, camera.fy, camera.cx, camera.cy, *coefficients]
    colmap = pycolmap.Camera(model="FULL_OPENCV", width=camera.width, height=camera.height, params=params)
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error = _MAX_PX * max(camera.width, camera.height) / 640 / 2
    options.ransac.random_seed = seed
    solution = pycolmap.estimate_and_refine_absolute_pose(px, xyz, colmap, options, return_covariance=True)
    if solution is None:
        return None
    matrix = solution["cam_from_world"].matrix()
    map_T_cam = inverse(make_pose(matrix[:, :3], matrix[:, 3]))
    # Of half the rotation and of the position of cam_T_map, along the camera's axes.
    to_map = np.zeros((6, 6))
    to_map[:3, :3] = -2 * map_T_cam[:3, :3]
    to_map[3:, :3] = -2 * map_T_cam[:3, :3] @ skew(matrix[:, 3])
    to_map[3:, 3:] = -map_T_cam[:3, :3]
    return map_T_cam, to_map @ solution["covariance"] @ to_map.T, np.asarray(solution["inlier_mask"], bool)
