"""Images and poses for training: an image cache decoded once, crops, and colour jitter."""

import os
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import torch
from numpy.random import Generator
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor

from groundwalk.geometry.gravity import upright_rotation, with_tilt_of_gravity
from groundwalk.geometry.poses import Array
from groundwalk.store.files import written_aside
from groundwalk.store.images import Image
from groundwalk.store.resizing import turned_crop
from groundwalk.training.poses import PoseBatch
from groundwalk.training.regressor_settings import Jitter, Turn

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)
_THREADS = 8


class ImageCache:
    """RGB images (H, W, 3) uint8 at one short side, in one file on disk that is read as it is needed.

    Full-size photographs take most of a training step to decode; here each is decoded once.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.shapes: NDArray[np.int64] = np.load(folder / "shapes.npy")
        self._pixels = np.memmap(folder / "pixels.u8", np.uint8, "r")
        self._starts = np.concatenate([[0], np.cumsum(np.prod(self.shapes, axis=1) * 3)])

    def __len__(self) -> int:
        return len(self.shapes)

    def __reduce__(self) -> tuple[type["ImageCache"], tuple[Path]]:
        return ImageCache, (self.folder,)  # another process opens the file itself

    def __getitem__(self, index: int) -> Image:
        pixels = self._pixels[self._starts[index] : self._starts[index + 1]]
        return pixels.reshape(*self.shapes[index], 3)

    @classmethod
    def build(cls, folder: Path, images: Iterable[Image]) -> "ImageCache":
        """Fill `folder`, unless it is there from an earlier run; `shapes.npy` comes last and marks it as whole."""
        if not (folder / "shapes.npy").exists():
            folder.mkdir(exist_ok=True)
            shapes = []
            with (folder / "pixels.u8").open("wb") as file:
                for image in images:
                    shapes.append(image.shape[:2])
                    file.write(image.tobytes())
            with written_aside(folder / "shapes.npy") as partial, partial.open("wb") as file:
                np.save(file, np.array(shapes, dtype=np.int64).reshape(-1, 2))
        return cls(folder)


@dataclass(frozen=True)
class View:
    """What a network sees of an image in the cache: a window (pixels) in its middle, turned upright or not."""

    height: int
    width: int
    upright: bool = False


@dataclass(frozen=True)
class Frames:
    """N frames: where each one's image is in the cache, its calibration and its pose.

    `index_N` into the cache; `K_N33` intrinsics in cached pixels (pixel centres at 0.5); `position_N3` (m) and
    `quaternion_N4` (unit xyzw) of map_T_cam; `scene_N` the index of the frame's scene; `gravity_N3` the unit vector
    down, in camera axes, NaN where the phone gives none.
    """

    cache: ImageCache
    index_N: NDArray[np.int64]
    K_N33: Array
    position_N3: Array
    quaternion_N4: Array
    scene_N: NDArray[np.int64]
    gravity_N3: Array

    def __len__(self) -> int:
        return len(self.index_N)

    def select(self, rows: NDArray[np.int64]) -> "Frames":
        return replace(self, **{name: values[rows] for name, values in vars(self).items() if name != "cache"})

    def seen(self, view: View) -> Rotation:
        """cam_R_seen (N): from the axes of the camera whose image the network sees to those of the camera."""
        if not view.upright:
            return Rotation.identity(len(self))
        return Rotation.from_matrix(upright_rotation(self.gravity_N3))

    def camera_poses(self, poses: PoseBatch, view: View) -> tuple[Array, Array]:
        """Positions (N, 3) and quaternions (N, 4) of map_T_cam from a network's answers to the view; where it's
        upright, with the tilt that gravity says."""
        position, quaternion = (t.detach().double().cpu().numpy() for t in (poses.position_B3, poses.quaternion_B4))
        if not view.upright:
            return position, quaternion
        map_R_cam = (Rotation.from_quat(quaternion) * self.seen(view).inv()).as_matrix()
        levelled = with_tilt_of_gravity(map_R_cam, self.gravity_N3)
        return position, np.asarray(Rotation.from_matrix(levelled).as_quat())

    def poses(self, device: torch.device) -> PoseBatch:
        return pose_batch(self.position_N3, self.quaternion_N4, self.scene_N, device)

    def centre_crops(self, view: View, device: torch.device) -> Tensor:
        """Normalised images (N, 3, height, width) from the middle of each image, as testing sees them."""
        crops = []
        if view.upright:
            crops = self._turned(self.seen(view), view, device)
        else:
            for index in self.index_N:
                image = self.cache[index]
                top, left = (image.shape[0] - view.height) // 2, (image.shape[1] - view.width) // 2
                crops.append(image[top : top + view.height, left : left + view.width])
        return normalised(to_tensor(crops, device))

    def training_crops(
        self, view: View, turn_deg: Turn | None, rng: Generator, device: torch.device, part: slice = slice(None)
    ) -> tuple[Tensor, PoseBatch]:
        """Images (M, 3, height, width) in 0..1 of a part of the frames for training, and the poses that they are to be
        given. Random numbers are drawn for all frames.

        Without `turn_deg`, a crop anywhere in the image with the image's pose, as the paper has it. With it, the
        largest yaw, pitch and roll either way, the picture that the camera would have taken turned by a random angle
        about its centre, and that turned pose: turning doesn't change what is visible from where, so the picture is
        right without knowing the scene.
        """
        mine = self.select(np.arange(len(self))[part])
        crops, quaternions = [], mine.quaternion_N4
        if turn_deg is None and not view.upright:
            spare_N2 = self.cache.shapes[self.index_N] - (view.height, view.width)
            corners = [[int(rng.integers(0, spare + 1)) for spare in spares] for spares in spare_N2]
            for index, (top, left) in zip(mine.index_N, corners[part], strict=True):
                crops.append(self.cache[index][top : top + view.height, left : left + view.width])
        else:
            angles = rng.uniform(-1, 1, (len(self), 3))[part] * (turn_deg or (0, 0, 0))
            cam_R_turned = mine.seen(view) * Rotation.from_euler("yxz", angles, degrees=True)
            crops = mine._turned(cam_R_turned, view, device)
            quaternions = (Rotation.from_quat(quaternions) * cam_R_turned).as_quat()
        return to_tensor(crops, device), pose_batch(mine.position_N3, quaternions, mine.scene_N, device)

    def _turned(self, cam_R_turned: Rotation, view: View, device: torch.device) -> list[Image]:
        """What the cameras see after these turns; for a GPU, which one thread can't keep busy, cropped by several."""

        def crop(index: int, K: Array, turn: Array) -> Image:
            return turned_crop(self.cache[index], K, turn, view.width, view.height)

        columns = self.index_N, self.K_N33, cam_R_turned.as_matrix()
        return list(map(crop, *columns) if device.type == "cpu" else _threads().map(crop, *columns))


@cache
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(min(_THREADS, os.cpu_count() or 1))


def pose_batch(position_N3: Array, quaternion_N4: Array, scene_N: NDArray[np.int64], device: torch.device) -> PoseBatch:
    position, quaternion = (torch.tensor(v, dtype=torch.float32, device=device) for v in (position_N3, quaternion_N4))
    return PoseBatch(position, quaternion, torch.tensor(scene_N, dtype=torch.long, device=device))


def to_tensor(images: list[Image], device: torch.device) -> Tensor:
    """Images (N, 3, H, W) in 0..1, channels last in memory, from N arrays (H, W, 3)."""
    stacked = torch.from_numpy(np.stack(images)).to(device, non_blocking=True)
    return stacked.permute(0, 3, 1, 2).float() / 255


def normalised(image_N3HW: Tensor) -> Tensor:
    """Images in 0..1 with ImageNet's mean and deviation taken out, as the backbones expect them."""
    mean = torch.tensor(IMAGENET_MEAN, device=image_N3HW.device)[:, None, None]
    return (image_N3HW - mean) / torch.tensor(IMAGENET_STD, device=image_N3HW.device)[:, None, None]


def jittered(
    image_N3HW: Tensor, extents: Jitter, rng: Generator, count: int | None = None, part: slice = slice(None)
) -> Tensor:
    """Images in 0..1 with colours changed at random, each in its own way. extents: the largest relative change of
    brightness, contrast and saturation, and of hue in turns of the colour circle, made in this order. The images are a
    `part` of so many; random numbers are drawn for all."""
    if not any(extents):
        return image_N3HW
    brightness, contrast, saturation, hue = extents

    def draw(extent: float) -> Tensor:
        values = rng.uniform(-extent, extent, (len(image_N3HW) if count is None else count, 1, 1, 1))[part]
        return torch.tensor(values, dtype=torch.float32, device=image_N3HW.device)

    image = (image_N3HW * (1 + draw(brightness))).clamp(0, 1)
    mean = _grey(image).mean((1, 2, 3), keepdim=True)
    image = (mean + (image - mean) * (1 + draw(contrast))).clamp(0, 1)
    grey = _grey(image)
    image = (grey + (image - grey) * (1 + draw(saturation))).clamp(0, 1)
    return shift_hue(image, draw(hue)) if hue else image


def _grey(image_N3HW: Tensor) -> Tensor:
    weights = torch.tensor([0.299, 0.587, 0.114], device=image_N3HW.device)[:, None, None]
    return (image_N3HW * weights).sum(1, keepdim=True)


def shift_hue(image_N3HW: Tensor, shift_N111: Tensor) -> Tensor:
    """Images in 0..1 whose hue is moved along the colour circle, in turns; value and HSV saturation stay."""
    top, bottom = image_N3HW.amax(1), image_N3HW.amin(1)
    chroma = top - bottom
    r, g, b = image_N3HW.unbind(1)
    safe = chroma.clamp_min(1e-6)
    sixth = torch.where(top == r, (g - b) / safe, torch.where(top == g, (b - r) / safe + 2, (r - g) / safe + 4))
    sixth = sixth + 6 * shift_N111.squeeze(1)

    def channel(offset: float) -> Tensor:
        k = (sixth + offset) % 6
        return top - chroma * torch.minimum(k, 4 - k).clamp(0, 1)

    return torch.stack([channel(5), channel(3), channel(1)], dim=1)
