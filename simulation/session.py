"""One simulated session: true poses, VIO, and how each image is rendered; written as 3D Scanner App exports it, with
what import reads of that: a JSON file a pose, info.json."""

import json
import math
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from groundwalk.geometry.poses import ARKIT_CAM_T_CAM, inverse
from groundwalk.simulation import camera
from groundwalk.simulation.camera import Exposure, Phone
from groundwalk.simulation.place import SceneryPlan, Vec
from groundwalk.simulation.render import Renderer, Sky
from groundwalk.simulation.settings import JPEG_QUALITY, MAX_SESSION_S, SimulateSettings
from groundwalk.simulation.view import View, row_times, shutter
from groundwalk.simulation.vio import simulate_vio
from groundwalk.simulation.walks import PlannedWalk, plan_walk
from groundwalk.store.files import written_aside
from groundwalk.store.simulated import FRAME

_METER_PX = (32, 24)  # size of the image for auto exposure
_METER_STEP_S = 0.5
_CAMERA_HZ = 60
_MOTION_S = 0.01
# Of ARKit's projection: near at a millimetre, far at infinity.
_PLANES = [[0.0, 0.0, -1.0, -0.001], [0.0, 0.0, -1.0, 0.0]]


@dataclass(frozen=True)
class SessionOutline:
    """A session's place in the plan: its name, number of images, preferred side of the course and start on it, and when
    the phone was started."""

    name: str
    images: int
    side: float
    start: float
    boot_s: float


@dataclass(frozen=True)
class SessionFrames:
    """One session as its phone saw it: times (s since boot), vio_T_cam (OpenCV axes), fx fy cx cy, exposure (s);
    `image_every` says which poses come with a JPEG."""

    name: str
    time_s: Vec
    vio_T_cam: Vec
    intrinsics_N4: Vec
    exposure_s: Vec
    width: int
    height: int
    image_every: int

    @property
    def image_indices(self) -> range:
        return range(0, len(self.time_s), self.image_every)


@dataclass(frozen=True)
class Shot:
    """One image to render: everything that a worker needs."""

    path: Path
    view: View
    velocity_cam: Vec
    spin_cam: Vec
    exposure: Exposure
    sky_seed: int
    clock_s: float
    noise_seed: int


@dataclass(frozen=True)
class Truth:
    """The truth of each of N poses: pose, velocity (m/s) and spin (rad/s) at the middle row, both in
    camera axes, and the camera: fx, fy, cx, cy in pixels."""

    world_T_cam: Vec
    velocity_cam_N3: Vec
    spin_cam_N3: Vec
    intrinsics_N4: Vec
    phone: Phone


@dataclass(frozen=True)
class SimulatedSession:
    """A planned session: what is written as JSON, times of its poses, int64, as whoever reads that gets them, the
    truth, and the images to render."""

    frames: SessionFrames
    t_ns: NDArray[np.int64]
    truth: Truth
    shots: list[Shot]


def outline(settings: SimulateSettings, scene: str, seed: int) -> list[SessionOutline]:
    """The sessions of a scene: training walks spread over the course's width, test walks between them, hours apart."""
    rng = np.random.default_rng([seed, zlib.crc32(scene.encode())])
    boot = rng.uniform(15_000, 40_000)
    sessions = []
    for kind, min_sessions in (("train", settings.train_sessions), ("test", settings.test_sessions)):
        total = settings.images[kind]
        count = max(min_sessions, math.ceil(total / settings.image_hz / MAX_SESSION_S))
        for k in range(count):
            images = (k + 1) * total // count - k * total // count
            reach = 1.0 if kind == "train" else 0.6
            side = reach * (2 * k / (count - 1) - 1) if count > 1 else 0.0
            start = (k + float(rng.uniform(0, 0.6))) / count
            sessions.append(SessionOutline(f"{kind}-{k + 1}", images, side, start, boot))
            boot += images / settings.image_hz + rng.uniform(2, 6) * 3600
    return sessions


def plan_session(
    plan: SessionOutline,
    scenery: SceneryPlan,
    settings: SimulateSettings,
    indoor: bool,
    renderer: Renderer,
    folder: Path,
    seed: int,
) -> SimulatedSession:
    """Walk, VIO and exposures: all of a session but its images, which go to `folder`."""
    seeds = np.random.SeedSequence([seed, zlib.crc32(f"{scenery.place.name}/{plan.name}".encode())])
    walk_seed, focus_seed, light_seed, time_seed, breath_seed = (np.random.default_rng(s) for s in seeds.spawn(5))
    every = max(1, round(settings.rate_hz / settings.image_hz))
    count = plan.images * every
    duration = count / settings.rate_hz
    phone = camera.draw_phone(settings, scenery.place.name, seed)
    walk = plan_walk(scenery.route, scenery.place, duration, plan.side, plan.start, walk_seed)

    t = _frame_times(count, settings.rate_hz, time_seed)
    time_s = plan.boot_s + t
    logged = camera.intrinsics(t, settings.width, settings.height, focus_seed)
    sky_seed = int(seeds.generate_state(1)[0])

    meter_t = np.arange(0, duration + _METER_STEP_S, _METER_STEP_S)
    grey = _meter(renderer, walk.world_T_cam(meter_t), Sky(sky_seed, plan.boot_s))
    brightness = np.interp(t, meter_t, grey)
    exposures = camera.auto_exposure(brightness, 1 / settings.rate_hz, indoor, light_seed)

    t_ns = np.array([round(v * 1e9) for v in time_s], np.int64)
    vio_T_cam, _ = simulate_vio(t_ns, walk.world_T_cam(t), int(seeds.generate_state(2)[1]))
    frames = SessionFrames(
        name=plan.name,
        time_s=time_s,
        vio_T_cam=vio_T_cam,
        intrinsics_N4=logged,
        exposure_s=np.array([e.duration_s for e in exposures]),
        width=settings.width,
        height=settings.height,
        image_every=every,
    )
    truth = _truth(walk, t, logged, camera.focus_breathing(t, settings, breath_seed), phone)
    shots = [
        Shot(
            path=folder / f"{FRAME.format(i)}.jpg",
            view=_view(truth, i, walk, t[i], settings),
            velocity_cam=truth.velocity_cam_N3[i],
            spin_cam=truth.spin_cam_N3[i],
            exposure=exposures[i],
            sky_seed=sky_seed,
            clock_s=float(t[i]),
            noise_seed=zlib.crc32(f"{seed}/{scenery.place.name}/{plan.name}/{i}".encode()),
        )
        for i in frames.image_indices
    ]
    return SimulatedSession(frames, t_ns, truth, shots)


def _frame_times(count: int, rate_hz: float, rng: np.random.Generator) -> Vec:
    """Seconds (N,) at which a phone's camera, whose own rate is another one, has frames, with their jitter."""
    t = np.round(np.arange(count) / rate_hz * _CAMERA_HZ) / _CAMERA_HZ
    t = np.clip(t + rng.normal(0, 4e-5, count), 0, None)
    return t if count < 2 or np.diff(t).min() > 0 else np.arange(count) / rate_hz


def _truth(walk: PlannedWalk, t: Vec, logged_N4: Vec, focus: Vec, phone: Phone) -> Truth:
    """The truth of poses logged at t (N,) with intrinsics logged_N4, whose focal length is off by the factor focus."""
    middle = t - phone.time_offset_s
    before, now, after = (walk.world_T_cam(middle + d) for d in (-_MOTION_S / 2, 0.0, _MOTION_S / 2))
    velocity = np.einsum("nji,nj->ni", now[:, :3, :3], after[:, :3, 3] - before[:, :3, 3]) / _MOTION_S
    turn = (inverse(before) @ after)[:, :3, :3]
    spin = np.stack([turn[:, 2, 1] - turn[:, 1, 2], turn[:, 0, 2] - turn[:, 2, 0], turn[:, 1, 0] - turn[:, 0, 1]], 1)
    # The JSON holds single precision, and the image is to agree with it.
    intrinsics = logged_N4.astype(np.float32).astype(np.float64)
    intrinsics[:, :2] *= focus[:, None]
    return Truth(now, velocity, spin / 2 / _MOTION_S, intrinsics, phone)


def _view(truth: Truth, i: int, walk: PlannedWalk, t: float, settings: SimulateSettings) -> View:
    fx, fy, cx, cy = (float(v) for v in truth.intrinsics_N4[i])
    phone = truth.phone
    moving = None
    if phone.readout_s:
        rows = walk.world_T_cam(t - phone.time_offset_s + row_times(phone.readout_s))
        moving = shutter(truth.world_T_cam[i], rows)
    return View(truth.world_T_cam[i], fx, fy, cx, cy, settings.width, settings.height, phone.lens, moving)


def take(shot: Shot, renderer: Renderer, settings: SimulateSettings) -> None:
    """Render, expose and write one image, whole or not at all."""
    sharp = renderer.render(shot.view, Sky(shot.sky_seed, shot.clock_s), settings.supersampling)
    rng = np.random.default_rng(shot.noise_seed)
    image = camera.expose(sharp, shot.view, shot.velocity_cam, shot.spin_cam, shot.exposure, rng)
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    with written_aside(shot.path) as partial:
        partial.write_bytes(data.tobytes())


def _meter(renderer: Renderer, world_T_cam: Vec, sky: Sky) -> Vec:
    """Mean grey level (N,) of what the camera sees."""
    w, h = _METER_PX
    focal = camera.FOCAL * w
    views = [View(pose, focal, focal, w / 2, h / 2, w, h) for pose in world_T_cam]
    return np.array([float(renderer.render(view, sky, 1).image.mean()) for view in views])


def write_frames(folder: Path, session: SessionFrames) -> None:
    """info.json and every frame's JSON; pictures are written apart."""
    folder.mkdir(parents=True, exist_ok=True)
    arkit, w, h = session.vio_T_cam @ ARKIT_CAM_T_CAM, session.width, session.height
    content: dict[str, Any] = {"info": {"title": session.name, "appVersionString": "1.9.7"}}
    for i, (fx, fy, cx, cy) in enumerate(session.intrinsics_N4):
        projection = [[2 * fx / w, 0, 1 - 2 * cx / w, 0], [0, 2 * fy / h, 2 * cy / h - 1, 0], *_PLANES]
        content[FRAME.format(i)] = {
            "cameraPoseARFrame": _float32(arkit[i]),
            "projectionMatrix": _float32(projection),
            "intrinsics": _float32([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]),
            "exposureDuration": float(np.float32(session.exposure_s[i])),
            "time": float(session.time_s[i]),
        }
    for name, values in content.items():
        (folder / f"{name}.json").write_text(json.dumps(values, indent=2) + "\n", encoding="utf-8")


def _float32(matrix: ArrayLike) -> list[float]:
    """Row-major values as the app has them, in single precision."""
    return np.asarray(matrix, np.float32).ravel().tolist()
