"""The lenses of a scene: which frames share one, and what is known of each before a model of its images tells.

ARKit and most apps state a pinhole matrix while the images have a lens's distortion, alike on the phones that were
measured (docs/explanation/sfm.md, Cameras). The adjustment of the model estimates it, from a prior: what the capture
states, or else what phones have.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pycolmap
from scipy.spatial.transform import Rotation

from groundwalk.geometry.lens import distort, undistort
from groundwalk.geometry.poses import Array
from groundwalk.geometry.shutter import readout_fraction, readout_lines
from groundwalk.sfm.cameras.motion import Motion
from groundwalk.sfm.database import Ints, create_database, image_id
from groundwalk.sfm.settings import SfmSettings
from groundwalk.store.choices import CameraOrigin
from groundwalk.store.files import written_aside

# k1 and k2 of phones' main cameras (docs/explanation/sfm.md, Cameras), in OpenCV's convention, and their covariance.
PHONE_K1_K2 = np.array([0.08, -0.12])
_PHONE_COVARIANCE = np.array([[0.05**2, -0.8 * 0.05 * 0.08], [-0.8 * 0.05 * 0.08, 0.08**2]])
# What a capture states is meant to be right.
STATED_SD = np.array([0.005, 0.01])
_STATED_READOUT_SD_S = 0.001
# Of a lens that nothing is known of, and others.
FAR_SD = np.array([0.1, 0.2])
K3_SD, KNOWN_K3_SD = 0.4, 0.02
READOUT_SD_S = 0.02
EXACT_SD = 1e-6
"""Of a prior that holds what it is of."""
_MAX_FOCAL_STEP = 0.08


@dataclass(frozen=True)
class LensPrior:
    """What is known of a lens: its frames' device, size and focal length, how many there are, coefficients (OpenCV's
    order, 8) and readout time, which mapping starts from, with their covariance (3, 3) of k1, k2 and readout, and the
    sd of k3; where they are from; and k1 and k2 and the readout time that the capture states, 0 and None for none."""

    lens_id: str
    frames: int
    coefficients: Array
    readout_s: float
    covariance: Array
    k3_sd: float
    origin: CameraOrigin
    stated: Array
    stated_readout_s: float | None = None
    is_undecided: bool = False
    """Images contradict the stated distortion, not beyond chance: it's held, and counts as uncertain."""
    start: Array | None = None
    """Coefficients (8,) that mapping starts from, where the stated ones are far off."""
    centre_px: Array = field(default_factory=lambda: np.zeros(2))
    is_known: bool = False
    """A model of other frames has told it, with where its principal point is (`Cameras`)."""


@dataclass(frozen=True)
class SceneLenses:
    """The lenses of a scene and which one each of N frames has (N,)."""

    priors: list[LensPrior]
    lens: Ints = field(repr=False)

    @property
    def coefficients(self) -> Array:
        """(L, 8)"""
        return np.array([prior.coefficients for prior in self.priors], float).reshape(-1, 8)

    @property
    def readout_s(self) -> Array:
        """(L,)"""
        return np.array([prior.readout_s for prior in self.priors], float)

    @property
    def centre_px(self) -> Array:
        """(L, 2)"""
        return np.array([prior.centre_px for prior in self.priors], float).reshape(-1, 2)


def lenses_of(frames: pd.DataFrame, device_of_session: dict[str, str]) -> tuple[Ints, list[str]]:
    """Which lens each of N frames was taken with (N,), and the lenses' names.

    Frames share a lens where their device, image size (of whatever orientation), stated distortion and readout time
    and, about, focal length are the same; an ultra-wide camera's focal length is half of the main one's.
    """
    device = frames["session_id"].map(device_of_session).fillna("").to_numpy(str)
    longer, shorter = frames[["width", "height"]].max(axis=1), frames[["width", "height"]].min(axis=1)
    size = [f"{w}x{h}" for w, h in zip(longer, shorter, strict=True)]
    stated = [",".join(f"{k:.6g}" for k in row) for row in frames["distortion"]]
    readout = frames["stated_readout_s"].to_numpy(str)
    group = pd.Series(["|".join(key) for key in zip(device, size, stated, readout, strict=True)])
    focal = np.log(frames["fx"].to_numpy(float) / longer.to_numpy(float))
    lens = np.zeros(len(frames), np.int64)
    names: list[str] = []
    for _, rows in group.groupby(group, sort=True).indices.items():
        first = int(rows[0])
        order = np.sort(rows)[np.argsort(focal[np.sort(rows)], kind="stable")]
        cluster = np.concatenate([[0], np.cumsum(np.diff(focal[order]) > _MAX_FOCAL_STEP)])
        for number in range(cluster[-1] + 1):
            members = order[cluster == number]
            lens[members] = len(names)
            widths = np.exp(focal[members].mean())
            names.append(f"{device[first] or 'unknown device'}, {size[first]}, focal length {widths:.2f} widths")
    return lens, names


def prior_lenses(frames: pd.DataFrame, device_of_session: dict[str, str], settings: SfmSettings) -> SceneLenses:
    """Each lens as it is stated, or as phones have it where nothing is stated."""
    lens_N, names = lenses_of(frames, device_of_session)
    priors = []
    for number, name in enumerate(names):
        members = np.flatnonzero(lens_N == number)
        first = frames.iloc[members[0]]
        stated, distortion = np.zeros(8), np.asarray(first["distortion"], float)
        stated[: len(distortion)] = distortion
        is_stated = settings.lens == "stated" or len(distortion) > 0
        coefficients, covariance = stated.copy(), np.diag([EXACT_SD**2, EXACT_SD**2, READOUT_SD_S**2])
        if not is_stated:
            coefficients[:2], covariance[:2, :2] = PHONE_K1_K2, _PHONE_COVARIANCE
        readout_s, stated_readout_s = 0.0, None
        if settings.readout_s is not None:
            readout_s, covariance[2, 2] = settings.readout_s, EXACT_SD**2
        elif not np.isnan(first["stated_readout_s"]):
            readout_s = stated_readout_s = float(first["stated_readout_s"])
            covariance[2, 2] = _STATED_READOUT_SD_S**2
        k3_sd, origin = (EXACT_SD, CameraOrigin.STATED) if is_stated else (K3_SD, CameraOrigin.PRIOR)
        known = (coefficients, readout_s, covariance, k3_sd, origin, stated[:2], stated_readout_s)
        priors.append(LensPrior(name, len(members), *known))
    return SceneLenses(priors, lens_N)


def with_lenses(frames: pd.DataFrame, lenses: SceneLenses) -> pd.DataFrame:
    """The frames table with the distortion that mapping starts from."""
    starts = np.array([prior.coefficients if prior.start is None else prior.start for prior in lenses.priors])
    return frames.assign(distortion=pd.Series(distortion_lists(starts[lenses.lens]), frames.index))


def started(prior: LensPrior, start: Array) -> LensPrior:
    """The lens where mapping starts from these coefficients (8,): one that isn't stated is then hardly known."""
    if np.array_equal(start, prior.coefficients):
        return prior
    if prior.origin == CameraOrigin.STATED:
        return replace(prior, start=start)
    covariance = prior.covariance.copy()
    covariance[:2, :2] = np.diag(FAR_SD**2)
    return replace(prior, coefficients=start, covariance=covariance)


def distortion_lists(coefficients_N8: Array) -> list[list[float]]:
    """Coefficients as tables have them: four, or eight where the lens needs them."""
    return [row[: 8 if row[4:].any() else 4].tolist() for row in coefficients_N8]


def lines_of(frames: pd.DataFrame) -> Array:
    """(N, 3) when each frame's pixels are exposed (`groundwalk.geometry.shutter`)."""
    return readout_lines(frames["first_row"], frames["width"], frames["height"])


def to_middle_row(xy_M2: Array, frame: Any, line: Array, readout_s: float, angular: Array) -> Array:
    """Pixels (M, 2) where a frame would have them if all rows were exposed with the middle one: turned by its angular
    velocity (3,). `line` (3,) says when they are exposed. The effect of its velocity depends on depth, and is left to
    the adjustment."""
    if not readout_s or not len(xy_M2):
        return xy_M2
    focal, centre = np.array([frame.fx, frame.fy]), np.array([frame.cx, frame.cy])
    coefficients = np.asarray(frame.distortion, float)
    rays = np.ones((len(xy_M2), 3))
    rays[:, :2] = undistort((xy_M2 - centre) / focal, coefficients)
    tau = readout_s * readout_fraction(line, xy_M2)
    rays = Rotation.from_rotvec(tau[:, None] * angular).apply(rays)
    return distort(rays[:, :2] / rays[:, 2:], coefficients) * focal + centre


def write_lens_database(
    source: Path, target: Path, frames: pd.DataFrame, names: Sequence[str], lenses: SceneLenses, motion: Motion
) -> None:
    """Write the database `target`: features of `source`, keypoints at the middle row's time, cameras with lenses."""
    readout, line = lenses.readout_s[lenses.lens], lines_of(frames)
    with written_aside(target) as partial:
        create_database(partial, frames, names)
        with (
            pycolmap.Database.open(source) as features,
            pycolmap.Database.open(partial) as opened,
            pycolmap.DatabaseTransaction(opened),
        ):
            for row, frame in enumerate(frames.itertuples(index=False)):
                keypoints = features.read_keypoints(image_id(row))
                xy, angular = keypoints[:, :2].astype(float), motion.angular[row]
                keypoints[:, :2] = to_middle_row(xy, frame, line[row], float(readout[row]), angular)
                opened.write_keypoints(image_id(row), keypoints)
                opened.write_descriptors(image_id(row), features.read_descriptors(image_id(row)))
