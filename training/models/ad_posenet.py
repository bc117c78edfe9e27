"""AD-PoseNet: PN that learns with parts of the image hidden where moving objects may be, and that weighs what it sees
(Huang et al., "Prior guided dropout for robust visual localization in dynamic environments", ICCV 2019)."""

from pathlib import Path

import torch
from torch import Tensor, nn

from groundwalk.store import UserError
from groundwalk.store.files import sha256_of
from groundwalk.store.hints import setting_of
from groundwalk.store.images import read_image
from groundwalk.training.models.posenet import PoseNet
from groundwalk.training.models.resnet import FEATURES
from groundwalk.training.models.uncertainty import CovarianceScale, mean_with_scatter
from groundwalk.training.poses import PoseBatch
from groundwalk.training.regressor_settings import ADPoseNetSettings, RegressorSettings

SAMPLES = 10  # masks whose answers are averaged at test time
PRIOR = 0.1  # probability that a pixel shows a moving object, where no image says
THRESHOLD = 0.2
_SIDE = 64  # of the prior, and of the noise that is repeated over larger images
_SQUEEZED = FEATURES // 16


class ADPoseNet(PoseNet):
    """One scene's poses, as the mean over SAMPLES masks of the image, and their scatter as covariance.

    A pixel with the probability mu of showing a moving object is hidden where a draw from a normal distribution with
    mean mu and deviation mu (1 - mu) isn't below THRESHOLD. The masks of testing are kept with the weights, so that
    an answer is the same each time.
    """

    prior: Tensor
    noise: Tensor

    def __init__(self, settings: ADPoseNetSettings, scenes: int = 1, outdoor: bool = False) -> None:
        super().__init__(settings, scenes, outdoor)
        squeeze, excite = nn.Linear(FEATURES, _SQUEEZED), nn.Linear(_SQUEEZED, FEATURES)
        self.channel_attention = nn.Sequential(squeeze, nn.ReLU(), excite, nn.Sigmoid())
        self.cell_attention = nn.Conv2d(FEATURES, 1, 1)
        for layer in (squeeze, excite, self.cell_attention):
            nn.init.kaiming_normal_(layer.weight)
            assert layer.bias is not None
            nn.init.zeros_(layer.bias)
        self.register_buffer("prior", torch.full((_SIDE, _SIDE), PRIOR))
        self.register_buffer("noise", torch.randn(SAMPLES, _SIDE, _SIDE, generator=torch.Generator().manual_seed(0)))
        self.covariance_scale = CovarianceScale()

    def initialise(self, poses: PoseBatch, settings: RegressorSettings, downloads: Path) -> str:
        origin = super().initialise(poses, settings, downloads)
        assert isinstance(settings, ADPoseNetSettings)
        if settings.prior_image is None:
            return origin
        path = Path(settings.prior_image)
        self.prior.copy_(_read_prior(path))
        return f"{origin}; prior {path.name}, sha256 {sha256_of(path)}"

    def _visible(self, normal_BHW: Tensor) -> Tensor:
        """Masks (B, 1, H, W) of draws from the standard normal distribution: 0 hides a pixel."""
        size = normal_BHW.shape[-2:]
        mean = nn.functional.interpolate(self.prior[None, None], size, mode="bilinear", align_corners=False)[0]
        return (mean + mean * (1 - mean) * normal_BHW < THRESHOLD).to(normal_BHW.dtype)[:, None]

    def _features(self, image_B3HW: Tensor) -> Tensor:
        maps: Tensor = self.backbone.maps(image_B3HW)
        channels = self.channel_attention(maps.mean((2, 3)))
        weighted: Tensor = (maps * torch.sigmoid(self.cell_attention(maps))).mean((2, 3))
        return weighted * channels

    def forward(self, image_B3HW: Tensor) -> PoseBatch:
        height, width = image_B3HW.shape[-2:]
        down, across = (torch.arange(side, device=image_B3HW.device) % _SIDE for side in (height, width))
        visible = self._visible(self.noise[:, down][:, :, across])
        seen = (image_B3HW * visible[:, None]).flatten(0, 1)
        position, log_q = (x.unflatten(0, (len(visible), -1)) for x in self._regress(seen))
        return mean_with_scatter(self.frames, position, log_q, self.covariance_scale)

    def loss(self, image_B3HW: Tensor, poses: PoseBatch) -> Tensor:
        """PN's loss of images with a mask each."""
        return super().loss(image_B3HW * self._visible(torch.randn_like(image_B3HW[:, 0])), poses)

    def calibrate(self, answers: PoseBatch, truth: PoseBatch) -> None:
        self.covariance_scale.fit(answers, truth)


def _read_prior(path: Path) -> Tensor:
    """Probabilities (64, 64) out of an image's grey values; UserError where it can't be read."""
    try:
        grey = torch.from_numpy(read_image(path)).float().mean(dim=-1) / 255
    except UserError as error:
        expected = "an image whose grey values say how often moving objects hide a pixel: white for always"
        raise UserError(
            "the prior of AD-PoseNet can't be read",
            where=path,
            expected=expected,
            found=error.details["found"],
            do=f"correct {setting_of('train.regressors.AD-PoseNet', 'prior_image')}, or leave it out: then one "
            "probability holds everywhere",
        ) from None
    return nn.functional.adaptive_avg_pool2d(grey[None], _SIDE)[0]
