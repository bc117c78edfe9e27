"""MS-T against its authors' code on the same weights and feature maps; skips where that isn't fetched."""

import os
from pathlib import Path

import pytest
import torch
from torch import nn

from benchmarks.official_mst import GivenMaps, copy_weights, official_model
from groundwalk.store import UserError
from groundwalk.training.models.ms_transformer import MSTransformer
from groundwalk.training.poses import PoseBatch

SCENES, BATCH = 3, 2


@pytest.fixture
def official() -> Path:
    folder = os.environ.get("MS_TRANSFORMER")
    if not folder:
        pytest.skip("MS_TRANSFORMER names no folder with MS-Transformer's official code")
    return Path(folder)


def test_poses_and_loss_are_the_official_ones(official: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    torch.manual_seed(0)
    backbone = GivenMaps()
    backbone.maps = torch.randn(BATCH, 40, 28, 28), torch.randn(BATCH, 112, 14, 14)
    theirs, pose_loss = official_model(official, SCENES, backbone)
    ours = MSTransformer(SCENES)
    copy_weights(theirs, ours)
    monkeypatch.setattr(ours, "_maps", lambda _: backbone.maps)
    theirs.eval()
    ours.eval()
    image = torch.zeros(BATCH, 3, 224, 224)
    quaternion = nn.functional.normalize(torch.randn(BATCH, 4), dim=-1)
    position, scene = torch.randn(BATCH, 3), torch.tensor([2, 0])
    with torch.no_grad():
        answer = theirs({"img": image, "scene": scene})
        vectors = ours._decode(image)
        mine = ours._regress(vectors[0], vectors[1], scene)
        assert torch.allclose(answer["scene_log_distr"], vectors[2].log_softmax(1), atol=1e-5)
        assert torch.allclose(answer["pose"][:, :3], mine[0], atol=1e-5)
        assert torch.allclose(nn.functional.normalize(answer["pose"][:, 3:], dim=-1), mine[1], atol=1e-5)
        # Ours takes the nearer of q and -q, the official loss q as it stands: here that is the nearer one.
        quaternion *= torch.sign((mine[1] * quaternion).sum(-1, keepdim=True))
        truth = torch.cat([position, quaternion], dim=1)
        expected = pose_loss(answer["pose"], truth) + nn.functional.nll_loss(answer["scene_log_distr"], scene)
        assert ours.loss(image, PoseBatch(position, quaternion, scene)).item() == pytest.approx(
            expected.item(), rel=1e-5
        )


def test_another_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="isn't MS-Transformer's official code"):
        official_model(tmp_path, 1)
