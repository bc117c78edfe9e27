"""The paper's rule against an independent literal one, and its invariances."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from groundwalk.fusion.methods.localiser import Estimate, Status
from groundwalk.fusion.methods.paper_rule import PaperRule, PaperRuleOptions, reference, similarity
from groundwalk.geometry import GeometryError
from groundwalk.geometry.poses import make_pose
from tests.fusion.literal_rule import label_walk, literal_frames
from tests.fusion.random_walks import RandomWalk, random_walk
from tests.known import there

# Each option's other readings, for the random choice below.
READINGS: dict[str, list[Any]] = {
    "n": [2, 2, 1, 3],
    "d_th_m": [0.4, 0.4, 0.2],
    "o_th_deg": [4.0, 4.0, 2.0],
    "gamma": [0.99, 0.999, 0.95],
    "alignment_frames": ["n+1", "n+1", "n+2"],
    "rotation_step": ["scalar_part", "norm"],
    "pair_check": ["lengths", "se3"],
    "comparison": ["<=", "<"],
    "similarity": ["cosine", "metric"],
    "drift_count": ["skip", "reset"],
    "reference": ["averaged_poses", "per_frame"],
    "position_average": ["geometric_median", "mean"],
    "realign_from": ["trigger", "next", "recent"],
    "before_first_lock": ["none", "prediction"],
    "while_aligning": ["last_reference", "none"],
    "interval_tolerance_s": [0.5, 0.2],
}


def random_options(seed: int) -> PaperRuleOptions:
    rng = np.random.default_rng([seed, 1])
    values = {name: choices[rng.integers(len(choices))] for name, choices in READINGS.items()}
    if values["n"] == 1 and values["alignment_frames"] == "n+1":
        values["position_average"] = "mean"  # of two points every point between them is a geometric median
    return PaperRuleOptions(similarity_m=0.8, similarity_deg=6.0, **values)


def fused(walk: RandomWalk, localiser: PaperRule) -> list[Estimate]:
    return [localiser.step(int(t), v, a) for t, v, a in zip(walk.t_ns, walk.vio, walk.apr, strict=True)]


def labels(walk: RandomWalk, estimates: list[Estimate]) -> list[str]:
    """What the paper counts: the status of each frame, `reliable` where a later frame confirmed it."""
    confirmed = {t for e in estimates for t, _ in e.confirms}
    return ["reliable" if t in confirmed else str(e.status) for t, e in zip(walk.t_ns, estimates, strict=True)]


@pytest.mark.parametrize("block", [*range(3), *(pytest.param(block, marks=pytest.mark.slow) for block in range(3, 10))])
def test_agrees_with_the_literal_rule(block: int) -> None:
    """On each frame and status of 1,000 walks: half with the defaults, half with random readings of the open points."""
    seen: set[str] = set()
    for seed in range(100 * block, 100 * block + 100):
        options = PaperRuleOptions() if seed % 2 else random_options(seed)
        localiser = PaperRule(options)
        # Two odometry sessions, one after the other: the second must not know of the first.
        for walk in (random_walk(seed, 28), random_walk(seed + 10_000, 12)):
            localiser.reset()
            estimates = fused(walk, localiser)
            expected = label_walk(literal_frames(walk), options)
            assert [str(e.status) for e in estimates] == [a.live for a in expected], f"seed {seed}"
            assert labels(walk, estimates) == [a.label for a in expected], f"seed {seed}"
            for estimate, answer in zip(estimates, expected, strict=True):
                if estimate.map_T_cam is not None:
                    assert np.allclose(estimate.map_T_cam, there(answer.pose), atol=2e-5), f"seed {seed}"
            seen.update(str(e.status) for e in estimates)
            seen.update(r for e in estimates for r in e.reasons)
    assert seen >= {"reliable", "optimised", "aligning", "none"}
    assert seen >= {"gap", "drift", "locked", "odometry_jump", "no_odometry", "no_prediction"}


@pytest.mark.parametrize("seed", range(8))
def test_the_odometry_frame_does_not_matter(seed: int) -> None:
    """Odometry's origin and heading are arbitrary: moving them moves nothing in the map. So is the zero of time.

    Not so with `per_frame`: averaged transforms depend on how far away odometry's origin is.
    """
    walk, options = random_walk(seed), random_options(seed).model_copy(update={"reference": "averaged_poses"})
    other_T_vio = make_pose(Rotation.random(rng=np.random.default_rng(seed)).as_matrix(), [30.0, -4.0, 11.0])
    moved = [None if p is None else other_T_vio @ p for p in walk.vio]
    a = fused(walk, PaperRule(options))
    b = fused(RandomWalk(walk.t_ns - 10**12, walk.map_T_cam, moved, walk.apr), PaperRule(options))
    assert [e.status for e in a] == [e.status for e in b]
    for one, two in zip(a, b, strict=True):
        if one.map_T_cam is not None:
            assert np.allclose(one.map_T_cam, there(two.map_T_cam), atol=1e-6)


def test_frames_without_a_prediction_change_no_decision() -> None:
    """Odometry at 10 Hz between predictions at 1 Hz gives the same answers at the predictions, and more between."""
    t_s = np.arange(0, 20, 0.1)
    poses = make_pose(Rotation.from_rotvec(np.outer(0.1 * t_s, [0, 1, 0])).as_matrix(), np.outer(t_s, [1.0, 0.0, 0.3]))
    sparse, dense = PaperRule(), PaperRule()
    for i, (t, pose) in enumerate(zip(t_s, poses, strict=True)):
        has_apr = i % 10 == 0
        answer = dense.step(round(t * 1e9), pose, pose if has_apr else None)
        if has_apr:
            assert answer.status == sparse.step(round(t * 1e9), pose, pose).status
        elif t > 2:
            assert answer.status == "optimised" and np.allclose(there(answer.map_T_cam), pose, atol=1e-9)


def straight(distances_m: Sequence[float], apr_distances_m: Sequence[float] | None = None) -> RandomWalk:
    """A walk along x at 1 Hz: odometry and predictions."""
    apr = distances_m if apr_distances_m is None else apr_distances_m
    rotation = np.eye(3)
    return RandomWalk(
        np.arange(len(distances_m), dtype=np.int64) * 10**9,
        make_pose(rotation, np.outer(apr, [1, 0, 0])),
        list(make_pose(rotation, np.outer(distances_m, [1, 0, 0]))),
        list(make_pose(rotation, np.outer(apr, [1, 0, 0]))),
    )


def test_thresholds_and_first_lock() -> None:
    walk = straight([0, 1, 2, 3, 4], [0, 1.25, 2.25, 3.25, 4.75])
    estimates = fused(walk, PaperRule(PaperRuleOptions(d_th_m=0.5)))
    assert [e.status for e in estimates] == ["none", "none", "reliable", "reliable", "reliable"]
    assert [t for t, _ in estimates[2].confirms] == [0, 10**9]
    assert estimates[4].signals["rpe_m"] == 0.5  # exactly on the threshold
    strict = fused(walk, PaperRule(PaperRuleOptions(d_th_m=0.5, comparison="<", n=1)))
    assert [e.status for e in strict] == ["none", "reliable", "reliable", "reliable", "optimised"]


def test_length_check_is_blind_to_direction_and_se3_is_not() -> None:
    """Point 3: a sideways error of 0.5 m on a 1 m step has an RPE of 0.12 m."""
    walk = straight([0, 1, 2, 3, 4])
    walk.apr[2] = make_pose(np.eye(3), [2, 0.5, 0])
    by_length = fused(walk, PaperRule())
    assert by_length[2].status == "reliable" and by_length[2].signals["rpe_m"] == pytest.approx(0.118, abs=1e-3)
    whole = fused(walk, PaperRule(PaperRuleOptions(pair_check="se3")))
    assert whole[2].status == "none" and whole[2].signals["rpe_m"] == pytest.approx(0.5)


def test_similarity_depends_on_the_origin_and_metric_does_not() -> None:
    """Point 5: 30 m from the origin a sideways error of 5 m scores 0.993, a radial one 1."""
    options, metric = PaperRuleOptions(), PaperRuleOptions(similarity="metric")
    far, sideways, radial = (make_pose(np.eye(3), x) for x in ([30, 0, 0], [30, 5, 0], [35, 0, 0]))
    assert similarity(far, sideways, options) == pytest.approx(0.993, abs=5e-4)
    assert similarity(far, radial, options) == pytest.approx(1.0)
    assert similarity(far, np.eye(4), options) == 1.0  # 0/0 at the origin counts as 1
    assert similarity(far, sideways, metric) == similarity(far, radial, metric) == pytest.approx(-4.0)


@pytest.mark.parametrize("average", ["gramkow", "karcher"])
@pytest.mark.parametrize("how", ["averaged_poses", "per_frame"])
def test_reference_of_exact_predictions_is_exact(average: str, how: str) -> None:
    """With predictions that differ from odometry by one transform and stand still, every way finds the transform."""
    rng = np.random.default_rng(0)
    map_T_vio = make_pose(Rotation.random(rng=rng).as_matrix(), [5.0, 1.0, -7.0])
    vio = np.repeat(make_pose(Rotation.random(rng=rng).as_matrix(), [1.0, 2.0, 3.0])[None], 3, axis=0)
    options = PaperRuleOptions(rotation_average=average, reference=how)
    assert np.allclose(reference(map_T_vio @ vio, vio, options), map_T_vio, atol=1e-9)


def test_bad_input_is_refused_or_named() -> None:
    localiser = PaperRule()
    pose = np.eye(4)
    assert localiser.step(10**9, pose, np.full((4, 4), np.nan)).reasons[0] == "prediction_invalid"
    with pytest.raises(GeometryError, match="time must rise"):
        localiser.step(10**9, pose, pose)
    with pytest.raises(GeometryError, match="odometry pose"):
        localiser.step(2 * 10**9, np.full((4, 4), np.nan), pose)
    assert localiser.step(3 * 10**9, None, pose).status is Status.NONE
