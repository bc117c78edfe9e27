"""What a phone will give the network: a regressor's preprocessing as data, and frames that went through it."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from groundwalk.export.regressor import TrainedRegressor
from groundwalk.geometry import Array
from groundwalk.geometry.cameras import Camera
from groundwalk.geometry.gravity import upright_rotation
from groundwalk.geometry.rows import evenly
from groundwalk.runtime.preprocessing import Preprocessing
from groundwalk.runtime.queries import Query
from groundwalk.store.images import read_image
from groundwalk.store.tables import camera_of
from groundwalk.training.data import IMAGENET_MEAN, IMAGENET_STD

_COEFFICIENTS = 8


@dataclass(frozen=True, eq=False)
class PhoneInputs:
    """A regressor's frames as queries, by row."""

    regressor: TrainedRegressor

    @cached_property
    def preprocessing(self) -> Preprocessing:
        """What is between an image and the network's input; the image's size is that of most training frames, the lens
        their median one."""
        frames = self.regressor.frames.iloc[self.regressor.rows("train")]
        sizes = frames.value_counts(["width", "height"])
        width, height = sizes.index[0]
        distortion = np.zeros((len(frames), _COEFFICIENTS))
        for row, coefficients in enumerate(frames["distortion"]):
            distortion[row, : len(coefficients)] = coefficients[:_COEFFICIENTS]
        lens = {
            "focal_factor": float((frames["fx"] / frames["stated_fx"]).median()),
            "distortion": np.trim_zeros(np.median(distortion, axis=0), "b").tolist(),
        }
        image = {"width_px": int(width), "height_px": int(height), "channels": "RGB", "turned": False}
        trained = self.regressor.trained
        resize: dict[str, Any] = {"step": "resize", "short_side_px": trained.resize}
        if trained.focal_px is not None:
            resize |= {"step": "pinhole", "focal_px": trained.focal_px}
        name = "upright_crop" if trained.upright else "centre_crop"
        crop = {"step": name, "width_px": trained.width, "height_px": trained.crop}
        normalise = {"step": "normalise", "mean": IMAGENET_MEAN, "sd": IMAGENET_STD}
        return Preprocessing(image, lens, (resize, crop, normalise))

    def query(self, row: int) -> Query:
        """A frame as a phone would ask about it: with the stated intrinsics, and gravity where the capture has it."""
        frame = self.regressor.frames.iloc[row]
        camera = camera_of(frame)
        factor = float(frame["stated_fx"]) / camera.fx
        stated = replace(camera, fx=camera.fx * factor, fy=camera.fy * factor, distortion=())
        down = frame[["gravity_x", "gravity_y", "gravity_z"]].to_numpy(float)
        return Query(read_image(frame["file"]), stated, down if np.isfinite(down).all() else None, None)

    def tensor(self, row: int) -> NDArray[np.float32]:
        """The network's input (1, 3, H, W) of a frame as a phone would ask about it."""
        *_, (_, tensor) = self.preprocessing.run(self.query(row))
        return tensor

    def tensor_as_trained(self, row: int) -> NDArray[np.float32]:
        """The network's input of a frame with the camera that training used for it, lens and all."""
        camera: Camera = camera_of(self.regressor.frames.iloc[row])
        lens = {"focal_factor": 1.0, "distortion": camera.distortion}
        query = replace(self.query(row), camera=replace(camera, distortion=()))
        *_, (_, tensor) = replace(self.preprocessing, lens=lens).run(query)
        return tensor

    def seen(self, row: int) -> Array:
        """map_R_seen (3, 3): the true rotation of the camera whose image the network sees."""
        gravity = self.query(row).gravity
        map_R_cam: Array = self.regressor.map_T_cam[row, :3, :3]
        if gravity is None or not self.preprocessing.is_upright:
            return map_R_cam
        return map_R_cam @ upright_rotation(gravity)

    def spread(self, split: str, count: int) -> list[int]:
        """At most so many rows of a split that a phone can ask about, evenly over its frames."""
        rows = self.regressor.rows(split)
        frames = self.regressor.frames.iloc[rows]
        sizes = zip(frames["width"], frames["height"], strict=True)
        can_ask = np.array([self.preprocessing.takes(width, height) for width, height in sizes], bool)
        if self.preprocessing.is_upright:
            can_ask &= frames["gravity_x"].notna().to_numpy()
        rows = rows[can_ask]
        return rows[evenly(len(rows), count)].tolist()

    @cached_property
    def input_size(self) -> tuple[int, int]:
        """Height and width of the network's input."""
        height, width = self.tensor(self.spread("train", 1)[0]).shape[2:]
        return height, width
