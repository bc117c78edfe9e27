"""What each message advises, followed to the letter: it then passes, or says something new."""

import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from groundwalk.alignment.check_models import CheckedMap, check_models, refusal
from groundwalk.alignment.checks.definitions import DEFINITIONS
from groundwalk.alignment.checks.results import CheckResult, with_status
from groundwalk.alignment.settings import AlignSettings
from groundwalk.consistency.decisions import Status
from groundwalk.store.choices import CheckName
from groundwalk.store.hints import ANY_SCENE
from groundwalk.store.tables import poses_of
from tests.alignment.checks.test_checks import NOISE, of_walk, shuffle
from tests.known import there
from tests.synthetic_walks import Scene, Walks

_LOOSE = {"lower": 0.0, "raise": 1e3}


def run(scene: Scene, **settings: Any) -> CheckedMap:
    return check_models(scene.inputs(), AlignSettings(**settings))


def failures(found: CheckedMap) -> list[CheckResult]:
    return with_status(found.checks, Status.FAILED)


def scale_vio(scene: Scene) -> None:
    vio = poses_of(scene.frames, "vio_cam")
    vio[of_walk(scene, 1), :3, 3] *= 0.85
    scene.set_vio(vio)


def tilt(scene: Scene) -> None:
    rows = of_walk(scene, 1)
    gravity = ["gravity_x", "gravity_y", "gravity_z"]
    turned = Rotation.from_euler("x", 8, degrees=True).apply(scene.frames.loc[rows, gravity].to_numpy(float).copy())
    scene.frames.loc[rows, gravity] = turned


def lose(scene: Scene) -> None:
    scene.images.loc[of_walk(scene, 1)[3:], "registered"] = False


def lose_most(scene: Scene) -> None:
    scene.images["registered"] = np.arange(len(scene.images)) % 3 == 0


def cut_in_two(scene: Scene) -> None:
    rows = of_walk(scene, 0)
    scene.images.loc[rows[5:20], ["registered", "model_id"]] = [False, None]
    scene.images.loc[rows[20:], "model_id"] = "incremental/1"


_BROKEN: dict[CheckName, Callable[[Scene], None]] = {
    CheckName.REGISTERED: lose_most,
    CheckName.SESSION_REGISTERED: lose,
    CheckName.SESSION_FOCAL_LENGTH: lambda scene: scene.set_focal("walk1", 1.1, 0.005),
    CheckName.SESSION_MOTION: lambda scene: shuffle(scene, of_walk(scene, 1)),
    CheckName.SESSION_SCALE: scale_vio,
    CheckName.SESSION_VERTICAL: tilt,
    CheckName.COMPONENT_LINK: cut_in_two,
}


@pytest.mark.parametrize("name", sorted(_BROKEN))
def test_what_a_failed_check_advises_settles_it(walks: Walks, name: CheckName) -> None:
    """By the setting that its remedy names, and without the session where it says so; a cause may have a better one."""
    scene, remedy = walks.make(**NOISE | {"sfm_m": 0.003, "sfm_deg": 0.02}), DEFINITIONS[name].remedy
    _BROKEN[name](scene)
    check = next(c for c in failures(run(scene)) if c.name == name)
    settings = re.findall(r"(raise|lower) \[align\] (\w+) in data/scenes/<scene>.toml", remedy)
    for verb, setting in settings:
        assert setting in AlignSettings.model_fields and ANY_SCENE in remedy and check.advice
        assert name not in {c.name for c in failures(run(scene, **{setting: _LOOSE[verb]}))}
    leaves_out = "take the session out" in check.advice
    if leaves_out:
        others = np.flatnonzero(scene.frames["session_id"] != check.subject.session_id)
        assert not failures(run(scene.part(others)))
    assert settings or leaves_out


# A walk whose check is undecided, and the same one as its evidence says.
_SHORT = {"frames": 8, "speed_m": 0.5, "sessions": 2}
_ODOMETRY_DRIFTS = {"drift_m": 0.04, "drift_yaw_deg": 1.0}
_ROUGH_SFM = {"frames": 12, "speed_m": 0.3, "sessions": 2, "sfm_deg": 2.0}
_UNDECIDED: dict[CheckName, tuple[str, dict[str, float], dict[str, float]]] = {
    CheckName.MAP_VERTICAL: (
        "a further session whose poses are in a gravity-aligned world",
        {"frames": 30, "sessions": 2, "phone_tilt_deg": 2}, {"sessions": 4},
    ),
    CheckName.SESSION_MOTION: ("a longer walk with turns", _ROUGH_SFM | {"sfm_deg": 1.5}, {"frames": 120}),
    CheckName.SESSION_TURNS: ("a walk with more turns", _SHORT | _ODOMETRY_DRIFTS, {"frames": 40}),
    CheckName.SESSION_SCALE: ("a longer walk in this session", _SHORT, {"frames": 20, "speed_m": 1.2}),
    CheckName.SESSION_VERTICAL: ("a longer walk in this session, or a further session", _ROUGH_SFM, {"frames": 60}),
    # More images make SfM's poses surer.
    CheckName.WINDOW_POSITION: (
        "more images there", {"frames": 8, "speed_m": 0.15, "sessions": 1} | _ODOMETRY_DRIFTS, {"sfm_m": 0.003}
    ),
    CheckName.WINDOW_ROTATION: ("more images there", _ROUGH_SFM, {"sfm_deg": 0.3}),
}  # fmt: skip


@pytest.mark.parametrize("name", _UNDECIDED)
def test_evidence_that_is_advised_decides(walks: Walks, name: CheckName) -> None:
    advice, start, follow = _UNDECIDED[name]

    def undecided(**changes: float) -> list[CheckResult]:
        checks = run(walks.make(**NOISE | {"seed": 1} | start | changes)).checks
        return [c for c in with_status(checks, Status.UNDECIDED) if c.name == name]

    before = undecided()
    assert before and all(c.advice == advice for c in before)
    assert not undecided(**follow)


def test_a_run_that_is_refused_goes_through_with_the_share_that_it_names(walks: Walks) -> None:
    scene = walks.make(**NOISE)
    for number in (0, 1):
        shuffle(scene, of_walk(scene, number))
    advice = there(refusal(run(scene), scene.frames, AlignSettings())).details["do"]
    assert "lower [align] min_consistent_fraction in data/scenes/" in str(advice)
    lower = {"min_consistent_fraction": 0.2}
    assert refusal(run(scene, **lower), scene.frames, AlignSettings(**lower)) is None


def test_every_check_has_advice_and_every_setting_that_it_names_exists() -> None:
    for definition in DEFINITIONS.values():
        assert definition.remedy or definition.evidence
        for setting in re.findall(r"\[align\] (\w+)", definition.remedy + definition.evidence):
            assert setting in AlignSettings.model_fields
