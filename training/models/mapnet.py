"""MapNet: PN that also learns the motion between frames of one walk (Brahmbhatt et al., "Geometry-aware learning of
maps for camera localization", CVPR 2018). Its pose graph at test time is fusion method pose_graph."""

from torch import Tensor, nn

from groundwalk.training.models.posenet import PoseNet
from groundwalk.training.models.regressor import LearnedWeights
from groundwalk.training.poses import PoseBatch, log_quaternion
from groundwalk.training.regressor_settings import MapNetSettings

_FRAMES = 3  # of a sequence


class MapNet(PoseNet):
    """PN, trained on sequences of three images of a session, one training frame apart.

    The loss adds, with learned weights of its own, that of the differences between each image's pose and the next's:
    of positions, and of log-quaternions, as the paper's eq. 3 and 4 have it.
    """

    def __init__(self, settings: MapNetSettings, scenes: int = 1, outdoor: bool = False) -> None:
        super().__init__(settings, scenes, outdoor)
        self.relative_weights = LearnedWeights(0.0, -3.0)

    def sequence(self) -> tuple[int, int]:
        return _FRAMES, 1

    def undecayed(self) -> list[nn.Parameter]:
        return [*super().undecayed(), *self.relative_weights.parameters()]

    def loss(self, image_B3HW: Tensor, poses: PoseBatch) -> Tensor:
        """The images of a sequence follow one another; B is a multiple of their number."""
        position, log_q = self._regress(image_B3HW)
        true_position, true_quaternion = self.frames.from_map(poses)
        true_log_q = log_quaternion(true_quaternion)
        l1 = nn.functional.l1_loss
        absolute = self.loss_weights(l1(position, true_position), l1(log_q, true_log_q))
        steps = [x.unflatten(0, (-1, _FRAMES)).diff(dim=1) for x in (position, true_position, log_q, true_log_q)]
        relative: Tensor = self.relative_weights(l1(steps[0], steps[1]), l1(steps[2], steps[3]))
        return absolute + relative
