"""Frames with ground truth as a PyTorch data set."""

from collections.abc import Callable
from typing import TypedDict

import pandas as pd
import torch
from torch import Tensor
from torch.utils.data import Dataset

from groundwalk.store.errors import UserError
from groundwalk.store.images import Image
from groundwalk.store.tables import camera_of, poses_of, with_cameras

_SPLITS = ("train", "val", "test")
_COEFFICIENTS = 8


class Item(TypedDict):
    """One frame: `image` RGB (3, H, W) uint8; `map_T_cam` (4, 4) float32, its ground truth (metres); `K` (3, 3)
    float32, intrinsics in pixels, the first pixel's outer corner being 0; `distortion` (8,) float32, OpenCV's k1, k2,
    p1, p2, k3, ..., zeros at the end; `frame_id`, and `quality`, the class of its ground truth."""

    image: Tensor
    map_T_cam: Tensor
    K: Tensor
    distortion: Tensor
    frame_id: str
    quality: str


Transform = Callable[[Item], Item]


class TorchDataset(Dataset[Item]):
    """The rows of import.frames of a split that have ground truth in align.ground_truth, in their order, each an `Item`
    with the image that `image` gives for its frame_id.

    The split is that of import.frames; val is a held-out part of the training walks. `transform` is applied to each
    item: images are as large as they were captured, and a batch needs them of one size.
    """

    def __init__(
        self,
        frames: pd.DataFrame,
        truth: pd.DataFrame,
        image: Callable[[str], Image],
        split: str | None = "train",
        transform: Transform | None = None,
    ) -> None:
        if split is not None and split not in _SPLITS:
            raise UserError(f"there is no split {split!r}", expected=f"one of {', '.join(_SPLITS)}, or None for all")
        columns = ["frame_id", "quality", *(name for name in truth.columns if name.startswith("map_cam_"))]
        frames = with_cameras(frames, truth).merge(truth[columns], on="frame_id", validate="1:1")
        here = frames["map_cam_tx"].notna() & (True if split is None else frames["split"] == split)
        frames = frames[here].reset_index(drop=True)
        self.image, self.transform = image, transform
        self.frame_ids, self.qualities = frames["frame_id"].tolist(), frames["quality"].tolist()
        self.cameras = [camera_of(frame) for frame in frames.itertuples(index=False)]
        self.map_T_cam = torch.tensor(poses_of(frames, "map_cam"), dtype=torch.float32)

    def __len__(self) -> int:
        return len(self.frame_ids)

    def __getitem__(self, index: int) -> Item:
        camera = self.cameras[index]
        distortion = torch.zeros(_COEFFICIENTS)
        distortion[: len(camera.distortion)] = torch.tensor(camera.distortion)
        item = Item(
            image=torch.from_numpy(self.image(self.frame_ids[index])).permute(2, 0, 1).contiguous(),
            map_T_cam=self.map_T_cam[index].clone(),
            K=torch.tensor(camera.matrix, dtype=torch.float32),
            distortion=distortion,
            frame_id=self.frame_ids[index],
            quality=self.qualities[index],
        )
        return self.transform(item) if self.transform else item
