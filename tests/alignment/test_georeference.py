"""Where on earth a map is, by positions that phones state: within its bounds, or refused with figures."""

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from groundwalk.alignment.check_models import check_models
from groundwalk.alignment.components import NO_SCALE, NOT_GIVEN, GivenFrame, PlacedComponent
from groundwalk.alignment.definition import STAGE
from groundwalk.alignment.georeference import NoGeoreference, of_gps
from groundwalk.alignment.given_frame import by_gps
from groundwalk.alignment.ground_truth import poses_in_map
from groundwalk.alignment.settings import AlignSettings
from groundwalk.geometry.earth import ENU_R_YUP, enu_of, geodetic_of
from groundwalk.geometry.fits import fit_sim3
from groundwalk.geometry.poses import Array, yaw_rotation
from groundwalk.store import DataRoot, execute
from groundwalk.store.choices import VerticalSource
from groundwalk.store.georeference import FILE, Georeference, read_georeference
from groundwalk.store.schemas import schema
from groundwalk.store.tables import poses_of, read_table
from tests.known import rewrite, table_of, without_vio
from tests.synthetic_walks import Scene, Walks

ORIGIN = (-17.8568, 179.9999, 40.0)  # some of it is beyond 180 degrees
ACCURACY_M = 4.5  # 3 m an axis


def fixes(scene: Scene, seed: int, accuracy_m: float = ACCURACY_M) -> pd.DataFrame:
    """What phones state a second apart of the true walks, at ORIGIN and turned by 0.7 rad: errors that last two
    minutes."""
    rng, tables = np.random.default_rng(seed), []
    enu = scene.true_T_cam[:, :3, 3] @ (ENU_R_YUP @ yaw_rotation(0.7)).T
    for name, of_one in scene.frames.groupby("session_id"):
        keep, error = np.exp(-1 / 120), rng.normal(size=3)
        errors = []
        for _ in range(len(of_one)):
            errors.append(error)
            error = keep * error + np.sqrt(1 - keep**2) * rng.normal(size=3)
        sd = accuracy_m / 1.51 * np.array([1, 1, 2])
        table = pd.DataFrame(
            geodetic_of(ORIGIN, enu[of_one.index] + sd * np.array(errors)),
            columns=["latitude_deg", "longitude_deg", "altitude_m"],
        )
        stated = {"accuracy_m": accuracy_m, "altitude_sd_m": sd[2]}
        tables.append(table.assign(recording=str(name), t_ns=of_one["t_ns"].to_numpy(), **stated))
    return pd.concat(tables, ignore_index=True)


def placed_by(
    scene: Scene, gps: pd.DataFrame, *, metric: bool = True, upright: bool = True
) -> tuple[Georeference, Array]:
    """The georeference, and the camera centres in the map."""
    checked = check_models(scene.inputs(), AlignSettings())
    component = checked.placed[0].component
    if not metric:
        component = replace(component, scale=NO_SCALE)
    if not upright:
        component = replace(component, vertical=replace(component.vertical, source=VerticalSource.NONE))
    placed = [replace(checked.placed[0], component=component)]
    if not metric:
        placed = [PlacedComponent(component, component.metric_S_sfm)]
    map_T_cam = poses_in_map(scene.images, placed)
    frames = scene.frames.assign(clock="boot")
    return of_gps(gps, frames, scene.recordings, map_T_cam, placed), map_T_cam[:, :3, 3]


@pytest.mark.parametrize("kind", ["metric", "no scale", "no vertical", "no altitude"])
def test_walks_lie_where_the_phones_were_within_the_stated_bounds(kind: str, walks: Walks, tmp_path: Path) -> None:
    """Of 8 scenes; the map's own errors are small beside GPS's."""
    inside = []
    for seed in range(8):
        scene = walks.make(seed=seed, frames=120)
        gps = fixes(scene, seed).assign(**({"altitude_m": np.nan} if kind == "no altitude" else {}))
        found, xyz = placed_by(scene, gps, metric=kind != "no scale", upright=kind != "no vertical")
        assert found.gives_scale == (kind == "no scale") and found.has_altitude == (kind != "no altitude")
        found.write(tmp_path / FILE)
        read = read_georeference(tmp_path)
        assert read is not None and read.describe() == found.describe()
        enu, sd, geodetic = read.places(xyz)
        truth = scene.true_T_cam[:, :3, 3] @ (ENU_R_YUP @ yaw_rotation(0.7)).T
        error = enu_of(ORIGIN, geodetic) - truth
        axes = slice(0, 2 if kind == "no altitude" else 3)
        inside.append(np.abs(error[:, axes]) <= 1.96 * sd[:, axes])
        assert np.linalg.norm(error[:, :2], axis=1).max() < 15 and found.worst_m < 20
        assert np.isnan(geodetic[:, 2]).all() == (kind == "no altitude") and np.isfinite(enu[:, :2]).all()
    share = np.concatenate(inside).mean()
    assert share >= 0.85, share


def test_positions_give_a_map_of_images_alone_scale_and_vertical(walks: Walks) -> None:
    """And the georeference's bounds have the scale's error in them still."""
    scene = walks.make(seed=2, frames=120)
    gps = fixes(scene, 2)
    scene.frames = without_vio(scene.frames)
    frames = scene.frames.assign(clock="boot")

    def placed_and_found(given: GivenFrame) -> tuple[PlacedComponent, Georeference]:
        (placed,) = check_models(scene.inputs(given=given), AlignSettings()).placed
        found = of_gps(gps, frames, scene.recordings, poses_in_map(scene.images, [placed]), [placed])
        return placed, found

    placed, found = placed_and_found(NOT_GIVEN)
    metric, again = placed_and_found(by_gps(found, placed))
    scale, vertical = metric.component.scale, metric.component.vertical
    assert scale.source.startswith("gps") and vertical.source == "gps"
    truth = fit_sim3(scene.true_T_cam[:, :3, 3], poses_of(scene.images, "sfm_cam")[:, :3, 3])
    assert abs(scale.log - np.log(truth.scale)) < 3 * scale.sd < 0.3
    assert np.arccos(vertical.up_sfm @ truth.rotation[1]) < 4 * vertical.sd < np.radians(20)
    assert again.enu_S_map.scale == pytest.approx(1, abs=1e-6) and not again.gives_scale
    np.testing.assert_allclose(again.covariance[6, 6], found.covariance[6, 6], rtol=1e-3)


def of_another_place(gps: pd.DataFrame) -> pd.DataFrame:
    return gps.assign(latitude_deg=gps["latitude_deg"] + np.where(gps["recording"] == "walk1", 3.6, 0))


def held_by_the_phone(gps: pd.DataFrame) -> pd.DataFrame:
    return gps.assign(latitude_deg=gps["latitude_deg"].iloc[0], longitude_deg=gps["longitude_deg"].iloc[0])


@pytest.mark.parametrize(
    ("change", "made", "why"),
    [
        (of_another_place, {"sessions": 2}, r"those of walk0 and walk1 by 398 km; nothing tells which"),
        (lambda gps: gps.assign(accuracy_m=65.0), {}, "0 of 180 positions can be used.*180 of an accuracy of 65 m"),
        (lambda gps: gps, {"sessions": 1, "speed_m": 0.2}, r"too short for a heading: over \d.* limit 10°: walk about"),
        (held_by_the_phone, {}, "the phone repeated an old position 180 times"),
        (lambda gps: gps.iloc[:0], {}, "no recording states a position on earth"),
        (lambda gps: gps.assign(t_ns=0), {}, "180 while no frame with ground truth was taken"),
    ],
)
def test_what_cannot_place_a_map_is_refused(
    change: Callable[[pd.DataFrame], pd.DataFrame], made: dict[str, Any], why: str, walks: Walks
) -> None:
    scene = walks.make(seed=3, **made)
    with pytest.raises(NoGeoreference, match=why) as refused:
        placed_by(scene, change(fixes(scene, 3)))
    assert "or name surveyed points" in str(refused.value)


def test_a_walk_of_another_place_among_three_and_rough_positions_are_left_out(walks: Walks) -> None:
    scene = walks.make(seed=5)
    gps = of_another_place(fixes(scene, 5))
    gps.loc[:9, "accuracy_m"] = 65.0
    found, _ = placed_by(scene, gps)
    assert found.used == 110 and found.rms_m < 10
    assert "10 of an accuracy of 65 m or worse" in found.describe() and "60 that are up to 398 km" in found.describe()


def test_altitudes_above_the_ellipsoid_and_above_sea_level_are_not_averaged(walks: Walks) -> None:
    """Of three phones, one of which states them 47 m higher: the height is unknown, and the reason is told."""
    scene = walks.make(seed=5)
    gps = fixes(scene, 5)
    gps.loc[gps["recording"] == "walk1", "altitude_m"] += 47
    found, xyz = placed_by(scene, gps)
    assert not found.has_altitude and np.isnan(found.places(xyz)[2][:, 2]).all()
    assert re.search(r"left out: all altitudes, as walk[02] has them [3-7]\d m lower than walk1", found.describe())
    with pytest.raises(NoGeoreference, match=r"don't tell it \(left out: all altitudes"):
        placed_by(scene, gps, upright=False)
    assert placed_by(scene, fixes(scene, 5))[0].has_altitude


def test_align_places_a_map_whose_import_kept_positions(data: DataRoot, capsys: pytest.CaptureFixture[str]) -> None:
    """Into a file of its own; without positions none; where they are too rough, the file has the reason alone."""
    execute(STAGE, "Place", "tiny", data)
    align = data.run("tiny", "Place", "align")
    assert not (align / FILE).exists()
    truth = read_table(data.captures("Place") / "true_poses.parquet", schema("simulate", "true_poses"))
    frames = table_of(data, "Place", "import", "frames")
    scene = Scene(frames, frames, frames, poses_of(truth, "map_cam"), np.ones(1))
    sessions = table_of(data, "Place", "import", "sessions").set_index("session_id")
    for accuracy_m, placed in ((2.0, True), (65.0, False)):
        gps = fixes(scene, 0, accuracy_m)
        gps["recording"] = gps["recording"].map(sessions["recording"])
        rewrite(data, "Place", "import", "gps", gps)
        execute(STAGE, "Place", "tiny", data, force=True)
        found, said = read_georeference(align), capsys.readouterr().err
        assert ("georeference by gps: " in said) == placed and (found is not None) == placed
        tables = [path for path in align.iterdir() if path.name not in (FILE, "recording.rrd") and path.is_file()]
        assert not any(b"179.99" in path.read_bytes() or b"latitude" in path.read_bytes() for path in tables)
    content = json.loads((align / FILE).read_text())
    assert content.keys() == {"refused"} and "an accuracy of 65 m or worse" in content["refused"]
