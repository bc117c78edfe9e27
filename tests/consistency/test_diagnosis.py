import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from groundwalk.consistency.diagnosis import MAX_ALIASED_FRACTION, diagnose
from groundwalk.geometry.poses import Array, make_pose
from tests.consistency.test_vio_agreement import pair


def walked(heading: Array, step_m: float) -> Array:
    """Poses (N, 4, 4) of a walk along these headings, in radians about y."""
    steps = step_m * np.stack([np.sin(heading), np.zeros_like(heading), np.cos(heading)], axis=1)
    positions = np.concatenate([np.zeros((1, 3)), np.cumsum(steps[:-1], axis=0)])
    return make_pose(Rotation.from_rotvec(heading[:, None] * [0.0, 1.0, 0.0]).as_matrix(), positions)


@pytest.mark.parametrize("strayed_deg", [0.0, 15.0, -25.0])
def test_a_way_there_and_back_on_which_the_heading_strays_is_not_aliased(strayed_deg: float) -> None:
    # 45 m each: VIO comes back many metres beside itself, which is what a heading may do over such a way.
    heading = np.pi * np.clip(np.linspace(-45, 46, 92) / 2, 0, 1)
    strayed = np.radians(strayed_deg) * np.linspace(0, 1, 92)
    assert diagnose([pair(walked(heading, 1.0), walked(heading + strayed, 1.0))]).aliased_fraction == 0


def test_two_look_alike_rooms_in_one_place_are_aliased() -> None:
    # Along a corridor, with two looks into rooms 20 m apart that the model has in one place.
    vio = walked(np.zeros(60), 0.5)
    sfm = vio.copy()
    sfm[40:, 2, 3] -= 20.0
    found = diagnose([pair(sfm, vio)])
    assert found.aliased_fraction > MAX_ALIASED_FRACTION
    assert found.aliased_m > 19.0
