"""Stock COLMAP on the images of an imported scene, as a process of its own: `python -m benchmarks.stock --help`.

Its own SIFT, as many features as we have, in images of 1600 px; incremental mapping with its own options, unless
`--gravity` takes its global one.
"""

import shutil
import sys
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import numpy as np
import pandas as pd
import pycolmap
import typer

from benchmarks.cost import Cost, run_timed
from groundwalk.geometry.poses import Array
from groundwalk.sfm.database import create_database, image_id, image_names
from groundwalk.sfm.mapping.attempts import settings_of_size
from groundwalk.sfm.model import load_models
from groundwalk.sfm.settings import SfmSettings
from groundwalk.store import DataRoot, UserError
from groundwalk.store.cli import DataOption, ProfileOption, SceneOption, new_app
from groundwalk.store.images import image_file
from groundwalk.store.settings import resolve_settings
from groundwalk.store.tables import poses_of, table_of

MOST_EXHAUSTIVE = 600
"""Images up to which every pair is matched; 180,000 pairs take half an hour on two cores."""

SPATIAL_M = 5.0
"""Images farther apart than this by VIO aren't matched by the spatial matcher."""

_SEQUENTIAL_OVERLAP = 10
_MAX_IMAGE_SIZE = 1600
_ANYWHERE_M = 1e3  # standard error of a position that only chooses pairs
_DOWN = np.array([0.0, -1.0, 0.0])  # in VIO's frame


class CameraModel(StrEnum):
    """Which of COLMAP's camera models each session's images get."""

    OPENCV = "OPENCV"
    FULL_OPENCV = "FULL_OPENCV"


class Pairs(StrEnum):
    """Which of COLMAP's matchers chooses the pairs."""

    EXHAUSTIVE = "exhaustive"
    SEQUENTIAL = "sequential"
    SPATIAL = "spatial"


app = new_app(__doc__ or "")


def run_stock(scene: str, profile: str, root: DataRoot, folder: Path, *options: str) -> tuple[int, Cost]:
    """Map an imported scene into `folder` with stock COLMAP, with features as sfm's settings say: its exit status and
    what it cost. What it prints is in <folder>.log."""
    settings = resolve_settings(SfmSettings, "sfm", root, profile, scene, [])
    command = [
        *(sys.executable, "-m", "benchmarks.stock", "--scene", scene, "--profile", profile, "--data", str(root.root)),
        *("--out", str(folder), "--settings", settings.model_dump_json(), *options),
    ]
    folder.parent.mkdir(parents=True, exist_ok=True)
    return run_timed(command, folder, _log_of(folder))


def stock_cost(scene: str, profile: str, root: DataRoot, folder: Path) -> Cost:
    """What `run_stock` cost; UserError where it failed."""
    status, cost = run_stock(scene, profile, root, folder)
    if status:
        raise UserError("stock COLMAP failed", where=_log_of(folder), found=f"exit status {status}")
    return cost


def _log_of(folder: Path) -> Path:
    return folder.with_name(f"{folder.name}.log")


def pairs_of(images: int) -> Pairs:
    """Which matcher so many images get, where none is named."""
    return Pairs.EXHAUSTIVE if images <= MOST_EXHAUSTIVE else Pairs.SEQUENTIAL


def largest_model(folder: Path) -> Path | None:
    """The folder of the model with the most images that `main` built; None where there is none."""
    sizes = {path: pycolmap.Reconstruction(path).num_reg_images() for path in sorted(folder.glob("[0-9]*"))}
    return max(sizes, key=lambda path: sizes[path], default=None)


def stock_poses(folder: Path, frames: int) -> tuple[Array, np.ndarray]:
    """sfm_T_cam (N, 4, 4) of the largest model, and 0 for each frame that is in it, -1 for others (N,)."""
    largest = largest_model(folder)
    if largest is None:
        return np.full((frames, 4, 4), np.nan), np.full(frames, -1)
    model = load_models([largest], frames)
    return model.sfm_T_cam, model.model


def _with_cameras(frames: pd.DataFrame, camera_model: CameraModel) -> tuple[pd.DataFrame, dict[str, pycolmap.Camera]]:
    """The frames in sessions of one image size each; and a camera for each of these, without distortion, at the median
    of the logged intrinsics."""
    sizes = frames.groupby(["session_id", "width", "height"], sort=True)
    cameras = {}
    for number, (_, rows) in enumerate(sizes):
        width, height = rows[["width", "height"]].iloc[0].tolist()
        camera = pycolmap.Camera.create_from_model_name(number + 1, camera_model, 1.0, width, height)
        camera.params = [*rows[["fx", "fy", "cx", "cy"]].median(), *np.zeros(len(camera.params) - 4)]
        camera.has_prior_focal_length = True
        cameras[str(number)] = camera
    return frames.assign(session_id=sizes.ngroup().astype(str)), cameras


@app.command()
def main(
    scene: SceneOption,
    out: Annotated[Path, typer.Option(help="Folder for COLMAP's database and models; emptied first.")],
    settings: Annotated[str, typer.Option(help="Settings of the sfm stage as JSON, for its features.")],
    profile: ProfileOption = "demo",
    data: DataOption = Path("data"),
    pairs: Annotated[Pairs | None, typer.Option(help="Its matcher; by the number of images unless named.")] = None,
    prior_sd_m: Annotated[
        float,
        typer.Option(help="Give it VIO's positions as priors with this standard error and a robust loss; 0: none."),
    ] = 0.0,
    gravity: Annotated[bool, typer.Option("--gravity", help="Its global mapper, told VIO's gravity.")] = False,
    camera_model: Annotated[CameraModel, typer.Option(help="Camera model of all images.")] = CameraModel.OPENCV,
) -> None:
    """Map an imported scene with stock COLMAP: one camera a session, started at the logged intrinsics."""
    root = DataRoot(data)
    frames = table_of(root.run(profile, scene), "import", "frames")
    sfm_settings = settings_of_size(SfmSettings.model_validate_json(settings), len(frames))
    shutil.rmtree(out, ignore_errors=True)
    images, database = out / "images", out / "database.db"
    names = image_names(frames)
    for name, image in zip(names, frames["image"], strict=True):
        source = image_file(image, root.captures(scene), root.run(profile, scene, "import"))
        (images / name).parent.mkdir(parents=True, exist_ok=True)
        (images / name).symlink_to(source.resolve())
    of_one_size, cameras = _with_cameras(frames, camera_model)
    create_database(database, of_one_size, names, cameras)

    extraction = pycolmap.FeatureExtractionOptions()
    extraction.use_gpu = False
    extraction.max_image_size = _MAX_IMAGE_SIZE
    extraction.sift.max_num_features = sfm_settings.max_features
    extraction.sift.first_octave = 0
    mode = pycolmap.CameraMode.PER_IMAGE
    pycolmap.extract_features(
        database, images, names, camera_mode=mode, extraction_options=extraction, device=pycolmap.Device.cpu
    )
    chosen = pairs or pairs_of(len(names))
    if prior_sd_m or gravity or chosen == Pairs.SPATIAL:
        _write_priors(database, frames, prior_sd_m or _ANYWHERE_M)
    _match(database, chosen)
    if gravity:
        globally = pycolmap.GlobalPipelineOptions()
        globally.mapper.rotation_averaging.use_gravity = True
        pycolmap.global_mapping(database, images, out, globally)
        return
    options = pycolmap.IncrementalPipelineOptions()
    options.use_prior_position = options.use_robust_loss_on_prior_position = prior_sd_m > 0
    pycolmap.incremental_mapping(database, images, out, options)


def _write_priors(database: Path, frames: pd.DataFrame, sd_m: float) -> None:
    """VIO's positions and gravity of the first session, as each session's positions have axes of their own."""
    vio_T_cam = poses_of(frames, "vio_cam")
    is_first = (frames["session_id"] == frames["session_id"].iloc[0]).to_numpy()
    with pycolmap.Database.open(database) as opened:
        for row in np.flatnonzero(is_first & np.isfinite(vio_T_cam[:, 0, 0])).tolist():
            prior = pycolmap.PosePrior(position=vio_T_cam[row, :3, 3], position_covariance=sd_m**2 * np.eye(3))
            prior.corr_data_id = opened.read_image(image_id(row)).data_id
            prior.coordinate_system = pycolmap.PosePriorCoordinateSystem.CARTESIAN
            prior.gravity = vio_T_cam[row, :3, :3].T @ _DOWN
            opened.write_pose_prior(prior)


def _match(database: Path, pairs: Pairs) -> None:
    matching = pycolmap.FeatureMatchingOptions()
    matching.use_gpu = False
    if pairs == Pairs.EXHAUSTIVE:
        pycolmap.match_exhaustive(database, matching, device=pycolmap.Device.cpu)
    elif pairs == Pairs.SEQUENTIAL:
        sequential = pycolmap.SequentialPairingOptions()
        sequential.overlap = _SEQUENTIAL_OVERLAP
        pycolmap.match_sequential(database, matching, pairing_options=sequential, device=pycolmap.Device.cpu)
    else:
        spatial = pycolmap.SpatialPairingOptions()
        spatial.ignore_z, spatial.max_distance = False, SPATIAL_M
        pycolmap.match_spatial(database, matching, pairing_options=spatial, device=pycolmap.Device.cpu)


if __name__ == "__main__":
    app()
