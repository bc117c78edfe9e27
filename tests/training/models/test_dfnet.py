"""Rendered views of map points, and what DFNet learns from them."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from torch import Tensor

from groundwalk.store import DataRoot, UserError, execute
from groundwalk.store.manifests import MANIFEST
from groundwalk.store.schemas import schema
from groundwalk.store.tables import write_table
from groundwalk.training.data import IMAGENET_MEAN, IMAGENET_STD
from groundwalk.training.definition import STAGE
from groundwalk.training.models.dfnet import DFNet, triplet_loss
from groundwalk.training.models.point_renderer import PointRenderer
from groundwalk.training.models.regressor import MapPoints
from groundwalk.training.poses import PoseBatch, log_quaternion
from groundwalk.training.regressor_settings import DFNetSettings
from tests.known import filled

RED, GREEN = [1.0, 0, 0], [0, 1.0, 0]
AHEAD = torch.tensor([[0.0, 0, 0, 1]])


def rendered(position: list[list[float]], colour: list[list[float]], at: Tensor, turn: Tensor = AHEAD) -> Tensor:
    """Colours (3, 20, 30) of points, each of them several times, by a pinhole of 10 px."""
    renderer = PointRenderer(4 * len(position))
    renderer.fit(MapPoints(torch.tensor(position), torch.tensor(colour), 10.0))
    image = renderer(at, turn, 20, 30)[0]
    return image * torch.tensor(IMAGENET_STD)[:, None, None] + torch.tensor(IMAGENET_MEAN)[:, None, None]


def test_points_lie_where_the_pinhole_sees_them() -> None:
    """5 m ahead, 2.5 m right and 1 m down: at (15 + 5, 10 + 2), the corner of four pixels; the same from aside."""
    for at in ([0.0, 0, 0], [7.0, -3, 2]):
        image = rendered([[2.5 + at[0], 1 + at[1], 5 + at[2]]], [RED], torch.tensor([at]))
        assert torch.allclose(image[0, 11:13, 19:21], torch.ones(2, 2), atol=0.1)
        assert float(image[0].max()) <= 1.001 and float(image[1:].abs().max()) < 1e-3
    quarter = torch.tensor([[0.0, 0.5**0.5, 0, 0.5**0.5]])  # ahead is the map's x
    turned = rendered([[5.0, 1, -2.5]], [RED], torch.zeros(1, 3), quarter)
    assert torch.allclose(turned[0, 11:13, 19:21], torch.ones(2, 2), atol=0.1)


def test_pixels_without_points_take_the_colours_around() -> None:
    image = rendered([[-4.0, 0, 5], [4, 0, 5]], [RED, GREEN], torch.zeros(1, 3))
    assert float(image.sum(0).min()) > 0.3
    assert image[0, 5, 3] > image[1, 5, 3] and image[1, 5, 27] > image[0, 5, 27]


def small_dfnet() -> tuple[DFNet, PoseBatch]:
    """With a cloud of coloured points in front of four cameras."""
    torch.manual_seed(0)
    model = DFNet(DFNetSettings(matching_from=0), points=3000)
    ahead = torch.tensor([0.0, 0, 6])
    model.see_map(MapPoints(torch.rand(3000, 3) * torch.tensor([12.0, 8, 4]) - 4 + ahead, torch.rand(3000, 3), 40.0))
    poses = PoseBatch(torch.randn(4, 3) * 0.3, AHEAD.repeat(4, 1), torch.zeros(4, dtype=torch.long))
    model.frames.fit(poses, True, True)
    return model, poses


def test_matching_pulls_the_estimated_pose_towards_the_true_one() -> None:
    model, poses = small_dfnet()
    image = model.renderer(poses.position_B3, poses.quaternion_B4, 48, 48)
    features, _ = model._features_and_pose(image)
    position, quaternion = model.frames.from_map(poses)
    for axis, step in ((0, 0.03), (0, -0.03), (1, 0.03), (1, -0.03)):
        pose = torch.cat([position, log_quaternion(quaternion)], dim=1).clone()
        pose[:, axis] += step / model.frames.scale[0]
        pose.requires_grad_()
        model._matching_loss(features, pose, image).backward()
        assert pose.grad is not None
        assert float(pose.grad[:, axis].sum()) * step > 0
    assert all(p.grad is None and p.requires_grad for p in model.adapters.parameters())


def test_matching_begins_after_some_steps() -> None:
    model, poses = small_dfnet()
    model.matching_from = 2
    calls = []
    model._matching_loss = lambda *_: calls.append(int(model.steps)) or torch.zeros(())  # type: ignore[method-assign, func-returns-value]
    for _ in range(4):
        model.loss(torch.randn(4, 3, 32, 32), poses)
    assert calls == [3, 4]


def test_rendered_views_leave_what_testing_normalises_by() -> None:
    model, poses = small_dfnet()
    norm = model.backbone.bn1
    norm.momentum = 1.0
    image = torch.randn(4, 3, 32, 32)
    model.loss(image, poses)
    assert norm.running_mean is not None
    assert torch.allclose(norm.running_mean, model.backbone.conv1(image).mean((0, 2, 3)), atol=1e-5)
    assert norm.momentum == 1.0


def test_triplet_loss_takes_the_hardest_of_four_negatives() -> None:
    """Vectors of one cell: 0 and 3 are images, 1 and 4 their views: apart by 1, others by 3, 4, 3 or 2."""
    real, view = torch.tensor([0.0, 3]).view(2, 1, 1, 1), torch.tensor([1.0, 4]).view(2, 1, 1, 1)
    assert float(triplet_loss([real], [view], 0.5)) == pytest.approx(0)
    assert float(triplet_loss([real], [view], 1.5)) == pytest.approx(0.5, abs=1e-4)


@pytest.mark.slow
def test_the_stage_gives_it_the_map(make_scene: Callable[..., Path]) -> None:
    data = DataRoot(make_scene())
    small = ["models=['DFNet']", "resize=40", "crop=32", "device=cpu"]
    small += [f"regressors.DFNet.{s}" for s in ("epochs=1", "weights='scratch'", "matching_from=0")]
    with pytest.raises(UserError, match="stage sfm of scene Wall hasn't been run"):
        execute(STAGE, "Wall", "tiny", data, small)
    folder = data.run("tiny", "Wall", "sfm")
    folder.mkdir()
    truth = pd.read_parquet(folder.parent / "align" / "ground_truth.parquet")
    poses = {name.replace("map", "sfm"): truth[name] for name in truth.columns if name.startswith("map_cam_")}
    xyz = dict(zip("xyz", np.random.default_rng(0).normal(size=(30, 3)).T, strict=True))
    cloud = filled("sfm", "points", 30, **xyz, model_id="0", r=200)
    images = filled("sfm", "images", len(truth), frame_id=truth["frame_id"], **poses, model_id="0")
    for name, table in (("images", images), ("points", cloud)):
        write_table(folder / f"{name}.parquet", table, schema("sfm", name))
    (folder / MANIFEST).write_text("{}", encoding="utf-8")
    trained = torch.load(execute(STAGE, "Wall", "tiny", data, small) / "weights" / "DFNet.pt")["state"]
    assert trained["renderer.position_P3"].std() > 0.5 and trained["renderer.focal_px"] > 20
    assert int(trained["steps"]) > 0
