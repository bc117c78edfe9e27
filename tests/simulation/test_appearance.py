"""Other lights: the same walks through the same walls; light, sky, leaves, ground and things differ."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from groundwalk.capture_import.definition import STAGE as IMPORT
from groundwalk.simulation.appearance import MOVED_FRACTION, seen_as
from groundwalk.simulation.camera import auto_exposure
from groundwalk.simulation.canvas import Canvas
from groundwalk.simulation.lighting import light_on_quad
from groundwalk.simulation.mesh import build_mesh
from groundwalk.simulation.place import Light, Place, Route
from groundwalk.simulation.raycast import Caster
from groundwalk.simulation.scenes import NAMES, scenery
from groundwalk.simulation.scenes.builder import Builder
from groundwalk.simulation.simulate import simulate
from groundwalk.simulation.walks import beside_course
from groundwalk.store import DataRoot, UserError, execute
from groundwalk.store.choices import Appearance
from groundwalk.store.schemas import schema
from groundwalk.store.simulated import appearances_of
from groundwalk.store.tables import read_table
from tests.known import read_picture
from tests.simulation.test_captures import SMALL

OTHERS = [a for a in Appearance if a != Appearance.SAME]
ROUTE = Route([(4.0, 4.0, 0), (4.0, -4.0, 0), (-4.0, -4.0, 0), (-4.0, 4.0, 0)], spread_m=0.3)


def names(place: Place) -> set[str]:
    return {q.name for q in place.quads}


@pytest.mark.parametrize("scene", NAMES)
@pytest.mark.parametrize("appearance", OTHERS)
def test_walls_stay_and_walkers_have_the_same_way(scene: str, appearance: Appearance) -> None:
    plan = scenery(scene, 0)
    there = seen_as(appearance, plan.place, plan.route, 0)
    assert there.light != plan.place.light
    assert there.obstacles == plan.place.obstacles and (there.low == plan.place.low).all()
    movable = {q.name for m in plan.place.movables for q in plan.place.quads[m.quads]}
    before = {q.name: q for q in plan.place.quads if q.name not in movable}
    after = {q.name: q for q in there.quads}
    assert before.keys() <= after.keys()
    assert all((after[name].corner == q.corner).all() and (after[name].up == q.up).all() for name, q in before.items())
    assert seen_as(Appearance.SAME, plan.place, plan.route, 0) is plan.place


@pytest.mark.parametrize("scene", NAMES)
def test_in_another_month_a_fifth_of_the_things_is_moved_removed_or_new(scene: str) -> None:
    plan = scenery(scene, 0)
    there = seen_as(Appearance.OTHER_MONTH, plan.place, plan.route, 0)
    after = {q.name: q for q in there.quads}
    gone, moved = 0, 0
    for thing in plan.place.movables:
        quads = plan.place.quads[thing.quads]
        gone += quads[0].name not in after
        moved += quads[0].name in after and not np.allclose(after[quads[0].name].corner, quads[0].corner)
    new = {name.partition(".")[0] for name in names(there) - names(plan.place)}
    # Where a thing finds no other place, it's gone.
    assert gone + moved + len(new) == int(np.ceil(MOVED_FRACTION * len(plan.place.movables)))
    assert {k.name for k in there.crowns} & {k.name for k in plan.place.crowns} == set()
    again = seen_as(Appearance.OTHER_MONTH, plan.place, plan.route, 0)
    assert [q.name for q in again.quads] == [q.name for q in there.quads]
    other = seen_as(Appearance.OTHER_MONTH, plan.place, plan.route, 1)
    assert len(plan.place.movables) < 8 or names(other) != names(there)


@pytest.mark.parametrize("seed", range(2))
def test_what_is_moved_stands_off_the_course_and_in_nothing(seed: int) -> None:
    plan = scenery("Bar", seed)
    there = seen_as(Appearance.OTHER_MONTH, plan.place, plan.route, seed)
    before = {q.name: q for q in plan.place.quads}
    feet = beside_course(plan.route)
    changed = [q for q in there.quads if q.name not in before or not np.allclose(q.corner, before[q.name].corner)]
    assert changed
    for quad in changed:
        corners = quad.corner + np.array([i * quad.right + j * quad.up for i in (0, 1) for j in (0, 1)])
        low, high = corners.min(axis=0), corners.max(axis=0)
        gap = np.maximum(np.maximum(low - feet, feet - high), 0)[:, [0, 2]]
        assert np.linalg.norm(gap, axis=1).min() > 0.35
        away = [np.maximum(np.maximum(low - o.high, o.low - high), 0).max() for o in plan.place.obstacles]
        assert min(away) > 0.2


def test_shadows_move_with_the_sun() -> None:
    b = Builder("yard", (20, 20), 5, Light(0.6, (0.5, 0.75, 0.45), 0.6), 0)
    b.floor("ground", (-8, -8), (8, 8), 0, lambda c: c.fill((150, 150, 150)))
    b.box("pillar", (0, 0), (1, 4, 1), lambda c: c.fill((90, 90, 90)))
    darkest = []
    for place in (b.place, seen_as(Appearance.OTHER_HOUR, b.place, ROUTE, 0)):
        mesh = build_mesh(place, 0.2, 0)
        light = light_on_quad(place.quads[0], place.light, Caster(mesh.vertices_V3, mesh.triangles_T3))[..., 1]
        rows, columns = np.nonzero(light < light.max() - 0.2)
        side = len(light) / 16
        darkest.append(np.array([columns.mean() / side - 8, rows.mean() / side - 8]))
        # A shadow lies on the other side of what throws it.
        assert darkest[-1] @ np.array(place.light.sun)[[0, 2]] < 0
    assert np.linalg.norm(darkest[0] - darkest[1]) > 1


def test_in_the_evening_lanterns_and_windows_shine_and_images_are_noisy() -> None:
    b = Builder("yard", (20, 20), 5, Light(0.6, (0.5, 0.75, 0.45), 0.6), 0)

    def wall(c: Canvas) -> None:
        c.fill((128, 128, 128))
        for k in range(5):
            c.window(0.3 + k, 1.0, 0.9 + k, 2.0)

    b.wall("wall", (-3, -2), (3, -2), 0, 3, wall)
    b.lamp_post("lamp", (2.0, 2.0))
    evening = seen_as(Appearance.EVENING, b.place, ROUTE, 0)
    day_mesh, mesh = (build_mesh(place, 0.05, 0) for place in (b.place, evening))
    assert len(evening.light.lamps) == 1
    glowing = [q.name for q in evening.quads if q.glow]
    assert glowing and all(name.startswith("lamp.light") for name in glowing)
    x, y, w, h = mesh.box_T4[0].astype(int)
    picture, by_day = (m.atlas_HW3[y : y + h, x : x + w, 1].astype(float) for m in (mesh, day_mesh))
    lit, dark = np.percentile(picture, 98), np.median(picture)
    assert lit > 200 > 1.5 * dark and by_day.max() - by_day.min() < 70
    grey, rng = np.full(20, 80.0), np.random.default_rng(0)
    day, late = (auto_exposure(grey, 0.1, False, rng, p.light.exposure)[-1] for p in (b.place, evening))
    assert late.noise > 2 * day.noise and late.duration_s > day.duration_s


def test_a_test_walk_in_two_appearances_differs_in_its_images_alone(tmp_path: Path) -> None:
    folder = simulate("Office", "tiny", DataRoot(tmp_path), [*SMALL, "appearances=['same', 'evening']"], processes=1)
    day, late = "test-1", "test-1-evening"
    others = dict.fromkeys(["train-1", "train-2", day], Appearance.SAME)
    assert appearances_of(folder) == {**others, late: Appearance.EVENING}
    files = sorted(p.name for p in (folder / day).iterdir())
    assert files == sorted(p.name for p in (folder / late).iterdir())
    differ = {name for name in files if (folder / day / name).read_bytes() != (folder / late / name).read_bytes()}
    pictures = {name for name in files if name.endswith(".jpg")}
    assert pictures and pictures <= differ
    changed = cv2.absdiff(*(read_picture(folder / session / min(pictures)) for session in (day, late)))
    assert changed.mean() > 3
    for name in sorted(differ - pictures):
        one, two = (json.loads((folder / session / name).read_text()) for session in (day, late))
        # Auto exposure follows the light; where the phone is doesn't.
        assert {k for k in one if one[k] != two[k]} <= {"exposureDuration", "cameraGrain", "title"}

    alone = simulate("Office", "tiny", DataRoot(tmp_path / "alone"), [*SMALL, "appearances=['evening']"], processes=1)
    assert appearances_of(alone)["test-1"] == Appearance.EVENING
    for name in files:
        if name not in pictures and name != "info.json":  # noise is drawn by the session's name, and info.json has it
            assert (alone / day / name).read_bytes() == (folder / late / name).read_bytes()

    imported = execute(IMPORT, "Office", "tiny", DataRoot(tmp_path), ["min_frames=1"])
    sessions = read_table(imported / "sessions.parquet", schema("import", "sessions")).set_index("session_id")
    assert sessions["appearance"].to_dict() == appearances_of(folder)


@pytest.mark.parametrize(
    "marker", ['{"sessions": {"test-1": {"appearance": "noon or evening"}}}', '{"sessions": ["test-1"]}']
)
def test_an_unknown_appearance_is_said(marker: str, tmp_path: Path) -> None:
    (tmp_path / "SIMULATED.json").write_text(marker)
    with pytest.raises(UserError, match=r"(?s)damaged.*evening"):
        appearances_of(tmp_path)


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ("appearances=['noon']", "noon"),
        ("appearances=['evening', 'evening']", "once"),
        ("appearances=[]", "appearances"),
    ],
)
def test_appearances_that_cannot_be_simulated_are_refused(setting: str, said: str, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=said):
        simulate("Office", "tiny", DataRoot(tmp_path), [*SMALL, setting], processes=1)
