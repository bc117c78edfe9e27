"""Format phone: the bundle predicts what training did, int8 where measuring says so, whole or not at all."""

import json
import shutil
import sys
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pandas as pd
import PIL.ExifTags
import PIL.Image
import pytest
import torch
from torch import nn
from typer.testing import CliRunner

from groundwalk.export import regressor
from groundwalk.export.__main__ import app
from groundwalk.export.phone import bundle, networks, quantisation
from groundwalk.export.phone.inputs import PhoneInputs
from groundwalk.export.phone.quantisation import HeldOut, Measured
from groundwalk.export.phone.readme import readme
from groundwalk.export.regressor import TrainedRegressor, load_regressor
from groundwalk.runtime import open_bundle
from groundwalk.runtime.bundle import onnx_session
from groundwalk.runtime.preprocessing import Preprocessing
from groundwalk.scoring.errors import position_error, rotation_error_deg
from groundwalk.store import DataRoot, UserError, execute
from groundwalk.store.choices import MapUnit
from groundwalk.store.images import read_image
from groundwalk.store.tables import GUESS_SD, poses_of
from groundwalk.training.build import Trained
from groundwalk.training.definition import STAGE
from groundwalk.training.models import anchored_mixture
from groundwalk.training.models.regressor import PoseRegressor
from groundwalk.training.poses import PoseBatch
from groundwalk.training.regressors import REGRESSORS
from tests.known import cells, rewrite, table_of
from tests.picture_wall import FOCAL, HEIGHT, WIDTH, write_scene

open_session = partial(onnx_session, threads=1)
UNITS = (("position", "m"), ("rotation", "deg"))
INTRINSICS = [50.0, 50.0, 32.0, 24.0]
PLACE = PIL.Image.Exif()
PLACE[PIL.ExifTags.Base.ImageDescription] = "@151.2153"


def export(data: Path, out: Path, *more: str, model: str = "PN", scene: str = "Wall") -> str:
    """What the command prints, or its error."""
    options = ["--scene", scene, "--profile", "tiny", "--data", str(data), "--out", str(out)]
    done = CliRunner().invoke(app, [*options, "--format", "phone", "--model", model, *more])
    if isinstance(done.exception, UserError):
        raise done.exception
    assert done.exit_code == 0, done.output
    return done.output


@pytest.mark.parametrize(("network", "metres", "degrees"), [("fp32", 1e-4, 1e-2), ("int8", 0.2, 5.0)])
def test_a_bundle_predicts_what_training_did(
    trained_wall: Path, wall_bundle: Path, network: str, metres: float, degrees: float
) -> None:
    opened = open_bundle(wall_bundle, network=network)
    rows = pd.read_parquet(trained_wall / "runs/tiny/Wall/train/predictions.parquet")
    images = [trained_wall / "captures/Wall" / f"{f.split('/')[0]}-{int(f[-6:])}.png" for f in rows["frame_id"]]
    answers = np.array([opened.predict(image, intrinsics=INTRINSICS).map_T_cam for image in images])
    assert position_error(answers, poses_of(rows, "map_cam")).max() < metres
    assert rotation_error_deg(answers, poses_of(rows, "map_cam")).max() < degrees


def test_int8_is_a_quarter_and_no_file_is_unlisted(wall_bundle: Path) -> None:
    manifest = json.loads((wall_bundle / "bundle.json").read_text())
    size = {name: network["bytes"] for name, network in manifest["networks"].items()}
    assert size["int8"] < 0.3 * size["fp32"] and manifest["network"] == "int8"
    there = {path.relative_to(wall_bundle).as_posix() for path in wall_bundle.rglob("*") if path.is_file()}
    assert there == {*manifest["files"], "bundle.json"}
    assert manifest["quantisation"]["int8"]["milliseconds"] < manifest["quantisation"]["fp32"]["milliseconds"]
    text = (wall_bundle / "README.md").read_text()
    assert "simulated" in text and "crop 32 instead of 224" in text and "5 test frames" in text


def test_a_readme_gives_no_metres_of_a_map_without_metric_scale() -> None:
    about = dict.fromkeys(("label", "written_by", "profile", "reduced", "network", "coreml", "simulated"), "")
    errors = {f"{name}_{of}_{unit}": 0.4 for name, unit in UNITS for of in ("median", "mean")} | {"frames": 4}
    more = {"scenes": ["Photos"], "networks": {}, "notes": []}
    preprocessing = Preprocessing({"width_px": 64, "height_px": 48}, {}, ())
    for unit, said in ((MapUnit.METRE, ("0.40 m and", "in metres")), (MapUnit.SFM, ("0.40 map units", "in map units"))):
        text = readme(about | more, preprocessing, errors, [unit])
        assert all(words in text for words in said) and ("metres" in text) == (unit is MapUnit.METRE)


def test_what_is_not_an_earlier_bundle_is_left_alone(trained_wall: Path, wall_bundle: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="holds earlier exports"):
        export(trained_wall, wall_bundle)
    bundle_of_mine = shutil.copytree(wall_bundle, tmp_path / "bundle")
    (bundle_of_mine / "golden" / "mine.txt").write_text("mine")
    with pytest.raises(UserError, match=r"(?s)holds other files than earlier exports.*golden/mine.txt"):
        export(trained_wall, bundle_of_mine, "--force")
    assert (bundle_of_mine / "golden" / "mine.txt").read_text() == "mine"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--format", "phone"], "format phone needs the id of a regressor"),
        (["--format", "colmap", "--model", "PN"], "format colmap is not of a regressor"),
        (["--format", "phone", "--model", "MS-T"], r"no regressor 'MS-T'(.|\n)*one of PN"),
    ],
)
def test_a_regressor_that_there_is_not_is_refused(
    trained_wall: Path, tmp_path: Path, options: list[str], message: str
) -> None:
    with pytest.raises(UserError, match=message):
        export(trained_wall, tmp_path / "out", *options, model="")
    assert not (tmp_path / "out").exists()


def test_a_run_that_does_not_fit_is_refused(trained_wall: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="stage train of scene Nowhere hasn't been run"):
        export(trained_wall, tmp_path / "out", scene="Nowhere")
    data = Path(shutil.copytree(trained_wall, tmp_path / "data"))
    models = data / "runs/tiny/Wall/train/models.parquet"
    models.write_bytes(models.read_bytes()[:-10])
    with pytest.raises(UserError, match="artefact train isn't as its stage wrote it"):
        export(data, tmp_path / "out")


def test_a_network_that_does_not_predict_what_training_did_is_refused(trained_wall: Path, wall_bundle: Path) -> None:
    loaded = load_regressor(DataRoot(trained_wall), "tiny", "Wall", "PN")
    loaded.predicted[:, 0, 3] += 0.02
    with pytest.raises(UserError, match=r"doesn't predict what training did(.|\n)*0\.020 m"):
        bundle._check_as_trained(PhoneInputs(loaded), wall_bundle / "fp32.onnx")


@pytest.mark.slow
def test_a_group_of_scenes_is_one_bundle(tmp_path: Path) -> None:
    data = write_scene(tmp_path / "data", "Wall", train=12, test=4, seed=0)
    write_scene(data, "Other", train=12, test=4, seed=1)
    (data / "scenes").mkdir()
    (data / "scenes" / "both.toml").write_text('members = ["Wall", "Other"]\nstages = ["train"]\n')
    settings = ["resize=40", "crop=32", "device=cpu", "threads=1", "regressors.MS-T.epochs=1"]
    execute(STAGE, "both", "tiny", DataRoot(data), settings)
    export(data, tmp_path / "bundle", scene="both", model="MS-T")
    opened = open_bundle(tmp_path / "bundle", network="fp32", verify=True)
    rows = pd.read_parquet(data / "runs/tiny/both/train/predictions.parquet")
    answer = opened.predict(data / "captures/Other/later-0.png", intrinsics=INTRINSICS)
    row = rows[(rows["scene"] == "Other") & (rows["frame_id"] == "later/000000")]
    assert answer.scene == row["picked_scene"].iloc[0] and opened.manifest["scenes"] == ["Wall", "Other"]
    assert position_error(answer.map_T_cam, poses_of(row, "map_cam")[0]) < 1e-3


def asked(folder: Path) -> PhoneInputs:
    """Frames of a regressor, six of them landscape and four portrait, as queries."""
    wide = np.arange(10) < 6
    frames = pd.DataFrame({"width": np.where(wide, WIDTH, HEIGHT), "height": np.where(wide, HEIGHT, WIDTH)})
    frames = frames.assign(fx=FOCAL, fy=FOCAL, cx=frames["width"] / 2, cy=frames["height"] / 2, stated_fx=FOCAL)
    frames = frames.assign(
        distortion=cells([()] * 10), first_row=None, gravity_x=np.nan, gravity_y=np.nan, gravity_z=np.nan
    )
    frames["file"] = cells(folder / f"{row}.png" for row in range(10))
    for file, width, height in zip(frames["file"], frames["width"], frames["height"], strict=True):
        PIL.Image.new("RGB", (width, height)).save(file, exif=PLACE)
    trained = Trained(WithCovariance(), ["Wall"], 40, 32, 45.0, 32, False)
    of = SimpleNamespace(frames=frames, trained=trained, rows=lambda split: np.arange(10))
    return PhoneInputs(cast(TrainedRegressor, of))


def test_frames_that_a_phone_cannot_ask_about_take_no_part(tmp_path: Path) -> None:
    inputs = asked(tmp_path)
    assert inputs.spread("train", 48) == list(range(6)) and inputs.input_size == (32, 32)


def test_golden_images_carry_no_place(tmp_path: Path) -> None:
    """A photo's EXIF may say where it was taken, and a bundle is given to others."""
    inputs, golden = asked(tmp_path), tmp_path / "golden"
    golden.mkdir()
    assert b"@151.2153" in (tmp_path / "0.png").read_bytes()
    assert bundle._query(inputs, 0, 0, golden, {})["image"] == "0.png"
    assert b"@151.2153" not in (golden / "0.png").read_bytes()
    assert np.array_equal(read_image(golden / "0.png"), read_image(tmp_path / "0.png"))


def test_a_guess_of_the_focal_length_is_not_what_phones_state(tmp_path: Path) -> None:
    data = DataRoot(write_scene(tmp_path / "data", "Wall", train=4, test=2, seed=0))
    frames = table_of(data, "Wall", "import", "frames").assign(fx=1.5 * FOCAL, fy=1.5 * FOCAL)
    for focal_sd, stated in ((0.0, 1.5 * FOCAL), (GUESS_SD, FOCAL)):
        rewrite(data, "Wall", "import", "frames", frames.assign(focal_sd=focal_sd))
        found, _, _ = regressor._frames(data, "tiny", "Wall", {})
        assert (found["stated_fx"] == stated).all() and (found["fx"] == FOCAL).all()


def test_errors_are_of_frames_of_the_scene_that_was_picked() -> None:
    frames = pd.DataFrame({"scene": "Wall", "picked_scene": ["Wall", "Other", "Wall"]})
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 0, 3] = 1.0, 50.0, 2.0
    of = SimpleNamespace(frames=frames, predicted=poses, map_T_cam=np.tile(np.eye(4), (3, 1, 1)))
    of.rows, of.covariance = lambda split: np.arange(3), np.full((3, 6, 6), np.nan)
    found = bundle._errors(cast(TrainedRegressor, of))
    assert (found["frames"], found["frames_of_another_scene"], found["position_mean_m"]) == (2, 1, 1.5)


class WithCovariance(PoseRegressor):
    """The colours' means as position, and a covariance that follows them."""

    def __init__(self) -> None:
        super().__init__()
        self.layer = nn.Linear(3, 3)

    def forward(self, image_B3HW: torch.Tensor) -> PoseBatch:
        position = self.layer(image_B3HW.mean((2, 3)))
        quaternion = nn.functional.normalize(torch.cat([position, torch.ones_like(position[:, :1])], 1), dim=-1)
        covariance = position.square().sum(1)[:, None, None] * torch.eye(6)
        return PoseBatch(position, quaternion, torch.zeros(len(position), dtype=torch.long), covariance)

    def loss(self, image_B3HW: torch.Tensor, poses: PoseBatch) -> torch.Tensor:
        raise NotImplementedError


def test_a_covariance_is_exported_with_its_pose(tmp_path: Path) -> None:
    model = WithCovariance().eval()
    networks.write_onnx(Trained(model, ["Wall"], 40, 32, None, 32, False), 32, 32, tmp_path / "a.onnx")
    image = torch.rand(1, 3, 32, 32)
    session = open_session(tmp_path / "a.onnx")
    assert [output.name for output in session.get_outputs()] == list(networks.OUTPUTS)
    given = session.run(["covariance"], {"image": image.numpy()})[0]
    with torch.no_grad():
        assert given == pytest.approx(model(image).covariance_B66.numpy(), rel=1e-5)


@pytest.mark.slow  # ten seconds each and more; PN's is in the bundle above
@pytest.mark.parametrize("name", REGRESSORS.builtin)
def test_every_regressor_has_a_network(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    torch.manual_seed(0)
    monkeypatch.setattr(anchored_mixture, "_MEDIAN_STEPS", 2)  # each is some hundred nodes, which take export's time
    entry = REGRESSORS[name]
    model = entry.make(entry.settings(), 1, False).eval()
    networks.write_onnx(Trained(model, ["Wall"], 72, 64, None, 64, False), 64, 64, tmp_path / "a.onnx")
    image = torch.rand(1, 3, 64, 64)
    given = open_session(tmp_path / "a.onnx").run(None, {"image": image.numpy()})
    with torch.no_grad():
        expected = model(image)
    assert len(given) == 3 + entry.gives_covariance
    assert np.abs(given[0] - expected.position_B3.numpy()).max() < 1e-3
    assert np.abs(given[1] - expected.quaternion_B4.numpy()).max() < 1e-3


FP32 = Measured(10.0, 1.0, 1.0)


def test_a_group_stays_in_float32_where_that_is_faster_or_more_accurate() -> None:
    both = Measured(8.0, 1.0, 1.0)
    table = {(): both, ("a",): Measured(7.0, 1.0, 1.0), ("b",): both, ("a", "b"): Measured(6.9, 1.0, 1.0)}
    search = quantisation._search
    assert search(["a", "b", "c"], (table | {("a", "c"): both}).__getitem__, FP32)[0] == ("a",)
    wrong = Measured(5.0, 2.0, 1.0)
    table = {(): wrong, ("a",): wrong, ("b",): Measured(6.0, 1.04, 1.0)}
    assert search(["a", "b"], table.__getitem__, FP32)[0] == ("b",)
    # What is just accurate enough gives way to what is more so in about the same time.
    table = {(): Measured(5.0, 1.04, 1.0), ("a",): Measured(9.0, 1.0, 1.0), ("b",): Measured(5.1, 1.0, 1.0)}
    assert search(["a", "b"], table.__getitem__, FP32)[0] == ("b",)


@pytest.mark.slow
def test_slower_int8_is_shipped_and_float32_recommended(
    trained_wall: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(quantisation.Quantised, "is_faster", False)
    assert "int8 is slower on the machine that exported" in export(trained_wall, tmp_path / "bundle")
    assert open_bundle(tmp_path / "bundle").network == "fp32"
    assert open_bundle(tmp_path / "bundle", network="int8").network == "int8"


def test_a_network_that_int8_spoils_is_shipped_in_float32_alone(
    wall_bundle: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(quantisation, "_search", lambda *_: ((), Measured(5.0, float("nan"), 1.0)))
    monkeypatch.setattr(quantisation, "measure", lambda *_: FP32)
    held_out = HeldOut([], np.zeros((0, 3)), np.zeros((0, 4)))
    result = quantisation.write_int8(wall_bundle / "fp32.onnx", tmp_path / "int8.onnx", [], held_out)
    assert "nan times those of fp32, over 1.05" in result.refusal and not (tmp_path / "int8.onnx").exists()


def test_what_stays_in_float32_is_stored_in_8_bits(
    wall_bundle: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # One small group is computed in int8: the difference is that of weights stored in 8 bits. Integer convolutions of a
    # network after two steps, whose answers are a tenth of its unit, differ by up to 8 % of the answer.
    monkeypatch.setattr(quantisation, "_search", lambda groups, trial, _: (kept := (*groups,)[:-1], trial(kept)))
    tensors = [np.random.default_rng(0).normal(size=(1, 3, 32, 32)).astype(np.float32)]
    held_out = HeldOut(tensors, np.full((1, 3), 1000.0), np.array([[0, 0, 0, 1.0]]))
    fp32, int8 = wall_bundle / "fp32.onnx", tmp_path / "int8.onnx"
    assert not quantisation.write_int8(fp32, int8, tensors, held_out).refusal
    assert int8.stat().st_size < 0.3 * fp32.stat().st_size
    answers = [open_session(file).run(["position"], {"image": tensors[0]})[0] for file in (fp32, int8)]
    assert np.abs(answers[0] - answers[1]).max() < 0.05 * np.abs(answers[0]).max()


def test_core_ml_is_left_out_with_a_reason(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "coremltools", None)
    trained = Trained(WithCovariance().eval(), ["Wall"], 40, 32, None, 32, False)
    assert networks.write_coreml(trained, 32, 32, tmp_path) == networks.NOT_INSTALLED
