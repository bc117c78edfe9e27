"""What AD-PoseNet hides of an image, and by which prior."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from scipy.stats import norm

from groundwalk.store import UserError
from groundwalk.training.models.ad_posenet import ADPoseNet
from groundwalk.training.poses import PoseBatch
from groundwalk.training.regressor_settings import ADPoseNetSettings

POSES = PoseBatch(torch.zeros(2, 3), torch.tensor([[0.0, 0, 0, 1]] * 2), torch.zeros(2, dtype=torch.long))
SETTINGS = ADPoseNetSettings(weights="scratch")


def seen(model: ADPoseNet, height: int, width: int, draws: int = 40) -> torch.Tensor:
    """How often each pixel is visible."""
    torch.manual_seed(0)
    return model._visible(torch.randn(draws, height, width)).mean((0, 1))


@pytest.mark.parametrize("prior", [0.05, 0.3])
def test_hides_as_often_as_the_prior_says(prior: float) -> None:
    model = ADPoseNet(SETTINGS)
    model.prior.fill_(prior)
    expected = norm.cdf((0.2 - prior) / (prior * (1 - prior)))
    assert float(seen(model, 96, 80).mean()) == pytest.approx(expected, abs=0.01)


def test_prior_of_an_image_is_stretched_over_the_view(tmp_path: Path) -> None:
    grey = np.zeros((30, 200), np.uint8)
    grey[:, 100:] = 255
    cv2.imwrite(str(tmp_path / "prior.png"), grey)
    settings = ADPoseNetSettings(weights="scratch", prior_image=str(tmp_path / "prior.png"))
    model = ADPoseNet(SETTINGS)
    assert "prior.png" in model.initialise(POSES, settings, tmp_path)
    often = seen(model, 48, 96)
    assert float(often[:, :46].min()) == 1 and float(often[:, 50:].max()) == 0


def test_prior_that_cannot_be_read_is_refused(tmp_path: Path) -> None:
    settings = ADPoseNetSettings(weights="scratch", prior_image=str(tmp_path / "none.png"))
    with pytest.raises(UserError, match=r"prior of AD-PoseNet can't be read[\s\S]*no such file"):
        ADPoseNet(SETTINGS).initialise(POSES, settings, tmp_path)


def test_hidden_parts_of_an_image_change_nothing() -> None:
    """With a prior that always hides the right half, in training and in testing."""
    torch.manual_seed(0)
    model = ADPoseNet(SETTINGS).eval()
    model.prior[:, :32], model.prior[:, 32:] = 0.0, 1.0
    image = torch.randn(2, 3, 64, 64)
    other = torch.cat([image[..., :32], torch.randn(2, 3, 64, 32)], dim=-1)
    with torch.no_grad():
        assert torch.equal(model(image).position_B3, model(other).position_B3)
        assert torch.equal(model.loss(image, POSES), model.loss(other, POSES))
