"""The same walks sampled otherwise: what passed is never refused, and what was refused never passes."""

from collections.abc import Callable, Iterator

import numpy as np
import pytest

from groundwalk.alignment.check_models import check_models, refusal
from groundwalk.alignment.checks.results import with_status
from groundwalk.alignment.settings import AlignSettings
from groundwalk.consistency.decisions import Status
from groundwalk.store.tables import poses_of
from tests.alignment.checks.test_checks import of_walk, shuffle, turn_otherwise
from tests.synthetic_walks import Scene, Walks

FRAMES = 48
NOISE = {"frames": FRAMES, "speed_m": 0.5, "sfm_m": 0.005, "sfm_deg": 0.05, "drift_m": 0.01, "drift_yaw_deg": 0.1}
SHORT = {"speed_m": 0.04, "sfm_m": 0.001}


def status(scene: Scene) -> Status:
    """Failed where a session gets no ground truth, undecided where a check of what was captured is."""
    found = check_models(scene.inputs(), AlignSettings())
    lost = [not found.frames.has_ground_truth[of_walk(scene, walk)].any() for walk in range(3)]
    if refusal(found, scene.frames, AlignSettings()) is not None or any(lost):
        return Status.FAILED
    return Status.UNDECIDED if with_status(found.checks, Status.UNDECIDED) else Status.PASSED


def resampled(scene: Scene) -> Iterator[Scene]:
    """Every second and third image, both halves of each walk, and another order of the files."""
    place = np.tile(np.arange(FRAMES), 3)
    orders = [place % 2 == 0, place % 3 == 1, place < FRAMES // 2, place >= FRAMES // 2]
    for rows in [*map(np.flatnonzero, orders), np.random.default_rng(0).permutation(3 * FRAMES)]:
        yield scene.part(rows)


def stretch_vio(scene: Scene, factor: float) -> None:
    vio, rows = poses_of(scene.frames, "vio_cam"), of_walk(scene, 1)
    vio[rows, :3, 3] *= factor
    scene.set_vio(vio)


@pytest.mark.parametrize(
    ("changes", "breaking", "expected"),
    [
        ({}, None, Status.PASSED),
        (SHORT, None, Status.UNDECIDED),
        ({"drift_m": 0.03, "drift_yaw_deg": 0.5, "sfm_deg": 0.2}, None, None),
        ({}, lambda scene: stretch_vio(scene, 0.88), Status.FAILED),
        ({}, lambda scene: turn_otherwise(scene, of_walk(scene, 1), 0.9), Status.FAILED),
        ({}, lambda scene: shuffle(scene, of_walk(scene, 1)), Status.FAILED),
    ],
)
def test_no_sampling_turns_the_result_round(
    walks: Walks, changes: dict[str, float], breaking: Callable[[Scene], None] | None, expected: Status | None
) -> None:
    """Near a limit (`expected` None) a sampling may leave undecided what another decides, but not the other way."""
    scene = walks.make(**NOISE | changes)
    if breaking is not None:
        breaking(scene)
    results = {status(scene), *map(status, resampled(scene))}
    assert results <= {expected} if expected else not {Status.PASSED, Status.FAILED} <= results
