"""Other lights: the same walks through the same walls; light, sky, leaves, ground and things differ."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from known import read_picture

from groundwalk.artefacts import DataRoot, UserError
from groundwalk.artefacts.choices import Appearance
from groundwalk.artefacts.simulated import appearance_of
from groundwalk.simulation.appearance import MOVED_FRACTION, seen_as
from groundwalk.simulation.camera import auto_exposure
from groundwalk.simulation.canvas import Canvas
from groundwalk.simulation.lighting import light_on_quad
from groundwalk.simulation.mesh import build_mesh
from groundwalk.simulation.place import Builder, Light, Place
from groundwalk.simulation.raycast import Caster
from groundwalk.simulation.scenes import NAMES, scenery
from groundwalk.simulation.simulate import simulate
from groundwalk.simulation.walks import Route, beside_course

OTHERS = [a for a in Appearance if a != Appearance.SAME]
SMALL = ["frame_fraction=0.006", "test_frames=600", "train_sessions=2", "test_sessions=1", "rate_hz=5", "width=96"]
SMALL += ["height=72", "texel_m=0.12"]
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


@pytest.mark.parametrize("seed", range(4))
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


def test_only_images_of_test_walks_differ(tmp_path: Path) -> None:
    folders = {}
    for appearance in (Appearance.SAME, Appearance.EVENING):
        settings = [*SMALL, f"appearance={appearance}"]
        folders[appearance] = simulate("Office", "tiny", DataRoot(tmp_path / appearance), settings, processes=1)
        marker = json.loads((folders[appearance] / "SIMULATED.json").read_text())
        assert marker["appearance"] == appearance_of(folders[appearance]) == appearance
    same, other = folders.values()
    files = sorted(p.relative_to(same) for p in same.rglob("*") if p.is_file() and p.name != "SIMULATED.json")
    assert files == sorted(p.relative_to(other) for p in other.rglob("*") if p.is_file() and p.name != "SIMULATED.json")
    differ = {p for p in files if (same / p).read_bytes() != (other / p).read_bytes()}
    pictures = {p for p in files if p.parts[0] == "test-1" and p.suffix == ".jpg"}
    assert pictures <= differ and all(p.parts[0] == "test-1" for p in differ)
    changed = cv2.absdiff(*(read_picture(f / min(pictures)) for f in (same, other)))
    assert changed.mean() > 3
    for path in sorted(p for p in differ if p.suffix == ".json"):
        one, two = (json.loads((f / path).read_text()) for f in (same, other))
        # Auto exposure follows the light; where the phone is doesn't.
        assert {k for k in one if one[k] != two[k]} <= {"exposureDuration", "cameraGrain"}


def test_captures_from_before_there_were_appearances_stay_up_to_date(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Their key knows no appearance, and it's the same."""
    folder = simulate("Office", "tiny", DataRoot(tmp_path), SMALL, processes=1)
    marker = json.loads((folder / "SIMULATED.json").read_text())
    assert "appearance" not in marker["settings"]
    del marker["appearance"]
    (folder / "SIMULATED.json").write_text(json.dumps(marker))
    assert appearance_of(folder) == Appearance.SAME
    simulate("Office", "tiny", DataRoot(tmp_path), SMALL, processes=1)
    assert "up to date" in capsys.readouterr().err


def test_an_unknown_appearance_is_said(tmp_path: Path) -> None:
    (tmp_path / "SIMULATED.json").write_text('{"appearance": "noon"}')
    with pytest.raises(UserError, match=r"(?s)damaged.*evening.*noon"):
        appearance_of(tmp_path)
    with pytest.raises(UserError, match="appearance"):
        simulate("Office", "tiny", DataRoot(tmp_path), [*SMALL, "appearance=noon"], processes=1)


def test_a_place_without_movable_things_keeps_its_things() -> None:
    place = replace(scenery("Stairs", 0).place, movables=[])
    there = seen_as(Appearance.OTHER_MONTH, place, scenery("Stairs", 0).route, 0)
    assert names(there) == names(place)
