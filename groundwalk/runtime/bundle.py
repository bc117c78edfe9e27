"""Poses of images by a bundle's network, without PyTorch."""

import os
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from groundwalk.geometry import Array
from groundwalk.runtime.bundle_file import ERRORS, FRAME, GOLDEN, PREPROCESSING, read_manifest, read_part
from groundwalk.runtime.preprocessing import Preprocessing
from groundwalk.runtime.queries import Query, known_of, query_of
from groundwalk.store.errors import UserError

if TYPE_CHECKING:
    from groundwalk.geometry.cameras import Camera


@dataclass(frozen=True)
class Prediction:
    """Where an image was taken.

    map_T_cam (4, 4), metres, OpenCV's camera axes; position (3,) and unit quaternion xyzw (4,) of the same; the scene
    that the network picked; covariance (6, 6) of (rotation, position) in the map's axes, rad and m, None where the
    network gives none; seconds by part.
    """

    map_T_cam: Array
    position: Array
    quaternion: Array
    scene: str
    covariance: Array | None
    seconds: dict[str, float]


def open_bundle(
    folder: str | os.PathLike[str], *, network: str | None = None, threads: int | None = None, verify: bool = False
) -> "Bundle":
    """Open a bundle that `groundwalk export --format phone` wrote.

    network: fp32 or int8; the one that the export recommends unless given. threads: of ONNX Runtime, as many as cores
    unless given. With `verify` the golden queries are asked, too. UserError where it isn't a bundle, is of a newer
    version, lacks a file or has one that was changed, or lacks that network.
    """
    bundle = Bundle(Path(folder), network, threads)
    if verify:
        bundle.verify()
    return bundle


class Bundle:
    """A network with its preprocessing; `open_bundle` makes it.

    `manifest` is what the bundle says of itself, `frame` of the map frame, `network` the network's name. `errors` are
    those of the scene's test frames, {} where the run had none.
    """

    def __init__(self, folder: Path, network: str | None, threads: int | None) -> None:
        self.folder = folder
        self.manifest = read_manifest(folder)
        networks: dict[str, Any] = self.manifest["networks"]
        self.network = network or str(self.manifest["network"])
        if self.network not in networks:
            raise UserError(
                f"a bundle has no network {self.network!r}", where=folder, expected=f"one of {', '.join(networks)}"
            )
        self.preprocessing = Preprocessing.parsed(read_part(folder, PREPROCESSING), folder / PREPROCESSING)
        self._answers = network_of(folder / networks[self.network]["file"], threads)

    def __repr__(self) -> str:
        m = self.manifest
        return f"Bundle({m['model']!r} of {', '.join(m['scenes'])}, {self.network})"

    @cached_property
    def frame(self) -> dict[str, Any]:
        return read_part(self.folder, FRAME)

    @cached_property
    def errors(self) -> dict[str, Any]:
        return read_part(self.folder, ERRORS) if ERRORS in self.manifest["files"] else {}

    def predict(
        self,
        image: "NDArray[np.uint8] | str | os.PathLike[str]",
        *,
        intrinsics: "Camera | Mapping[str, float] | ArrayLike | None",
        gravity: ArrayLike | None = None,
    ) -> Prediction:
        """Where an image was taken.

        image: RGB (H, W, 3) or grey (H, W), uint8, or a file, as the sensor delivers it. intrinsics: in pixels of that
        image, a Camera, a mapping with fx, fy, cx, cy (and width, height), K (3, 3) or the four numbers; the lens is
        known to the bundle. gravity: (3,), down, in camera axes (x right, y down, z forward).

        UserError where intrinsics lack or can't be, or the image isn't like those that the network was trained on.
        """
        return self.ask(query_of(image, known_of(intrinsics, gravity, None), "intrinsics of Bundle.predict"))

    def ask(self, query: Query) -> Prediction:
        """Where a query's image was taken; see `predict`."""
        start = time.perf_counter()
        *_, (_, tensor) = self.preprocessing.run(query)
        prepared = time.perf_counter()
        outputs = self._answers(tensor)
        seconds = {"preprocessing": prepared - start, "network": time.perf_counter() - prepared}
        position = outputs["position"][0].astype(float)
        rotation = self.preprocessing.camera_rotation(matrix_of(outputs["quaternion"][0]), query.gravity)
        covariance = outputs["covariance"][0].astype(float) if "covariance" in outputs else None
        scene = self.manifest["scenes"][int(outputs["scene"][0])]
        map_T_cam = np.eye(4)
        map_T_cam[:3, :3], map_T_cam[:3, 3] = rotation, position
        return Prediction(map_T_cam, position, _quaternion(rotation), scene, covariance, seconds)

    def verify(self) -> int:
        """Ask the golden queries; how many there are. UserError where a step of the preprocessing or the network gives
        something else here than where the bundle was written."""
        golden = read_part(self.folder, GOLDEN)
        for query in golden["queries"]:
            self._verify(query, golden["tolerances"])
        return len(golden["queries"])

    def _verify(self, golden: Mapping[str, Any], tolerances: Mapping[str, Any]) -> None:
        where = self.folder / "golden" / golden["image"]
        query = query_of(where, {**golden["intrinsics"], "gravity": golden["gravity"]}, where)
        tensor = np.empty(0, np.float32)
        for (name, made), step in zip(self.preprocessing.run(query), golden["steps"], strict=True):
            tensor = np.load(self.folder / "golden" / step["file"])
            difference = float(np.abs(made.astype(float) - tensor).mean()) if made.shape == tensor.shape else np.inf
            if difference > tolerances["steps"][name]:
                raise _not_golden(f"step {name}", where, tolerances["steps"][name], difference, "mean difference")
        outputs = self._answers(tensor)
        expected = golden["outputs"][self.network]
        limits = tolerances["networks"][self.network]
        metres = float(np.linalg.norm(outputs["position"][0] - expected["position"]))
        aligned = abs(float(np.dot(outputs["quaternion"][0], expected["quaternion"])))
        degrees = float(np.degrees(2 * np.arccos(min(1.0, aligned))))
        for value, limit, unit in ((metres, limits["position_m"], "m"), (degrees, limits["rotation_deg"], "deg")):
            if not value <= limit:
                raise _not_golden(f"network {self.network}", where, limit, value, unit)


def onnx_session(file: Path, threads: int | None) -> Any:
    """A session of ONNX Runtime; UserError where that is missing or can't load the file."""
    try:
        import onnxruntime
    except ImportError as error:
        raise UserError(
            "a bundle needs ONNX Runtime", found=error, do="pip install 'groundwalk[runtime]', or onnxruntime alone"
        ) from None
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    if threads is not None:
        options.intra_op_num_threads = threads
        # Threads that wait busily for more work make one query faster and everything else slower.
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    try:
        return onnxruntime.InferenceSession(str(file), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # ONNX Runtime's exceptions have no public base
        raise UserError(
            "ONNX Runtime can't load a bundle's network", where=file, found=error, do="update onnxruntime"
        ) from None


def network_of(file: Path, threads: int | None) -> Callable[[NDArray[np.float32]], dict[str, NDArray[Any]]]:
    """What gives a network's outputs by name for its input (1, 3, H, W); raises as `onnx_session`."""
    session = onnx_session(file, threads)
    names = [output.name for output in session.get_outputs()]
    return lambda tensor: dict(zip(names, session.run(None, {"image": tensor}), strict=True))


def matrix_of(quaternion: ArrayLike) -> Array:
    """The rotation (3, 3) of a quaternion x, y, z, w of any length."""
    q = np.asarray(quaternion, float)
    x, y, z, w = q / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def _quaternion(rotation: Array) -> Array:
    """The unit quaternion x, y, z, w >= 0 of a rotation (3, 3): an eigenvector (Bar-Itzhack, 2000)."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = rotation
    K = np.array(
        [
            [xx - yy - zz, yx + xy, zx + xz, zy - yz],
            [yx + xy, yy - xx - zz, zy + yz, xz - zx],
            [zx + xz, zy + yz, zz - xx - yy, yx - xy],
            [zy - yz, xz - zx, yx - xy, xx + yy + zz],
        ]
    )
    vector: Array = np.linalg.eigh(K)[1][:, -1]
    return vector if vector[3] >= 0 else -vector


def _not_golden(what: str, where: Path, limit: float, actual: float, unit: str) -> UserError:
    return UserError(
        f"a bundle's golden query comes out differently here: {what}",
        where=where,
        expected=f"at most {limit:.3g} {unit}",
        found=f"{actual:.3g} {unit}",
        do="use network fp32, or update onnxruntime and opencv-python-headless",
    )
