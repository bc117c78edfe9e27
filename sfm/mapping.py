"""Incremental mapping: from verified pairs to one model over all sessions."""

import json
import shutil
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import pycolmap

from artefacts.child import Report
from sfm.model import load_model
from sfm.settings import SfmSettings

_SMALLEST_MODEL = 3
_EASIER_MIN_INLIERS = 15
# Cauchy's loss keeps 95 % of least squares' efficiency on Gaussian noise at 2.385 sigma (Zhang, "Parameter estimation
# techniques", 1997); 1.4826 makes a median of absolute values a sigma.
_LOSS_WIDTH = 2.385 * 1.4826
_NARROWEST_LOSS_PX = 0.05
_FINAL_STEPS = 25
_BUILT = "built.json"
_FINAL = "final"


@dataclass(frozen=True)
class BuiltModel:
    """A model that mapping built: which attempt made it, its number there, its size, and whether it's the final one,
    adjusted with a Cauchy loss of width `loss_px`."""

    attempt: str
    number: int
    images: int
    points: int
    observations: int
    mean_track_length: float
    mean_reprojection_px: float
    chosen: bool = False
    loss_px: float = 0.0

    @property
    def model_id(self) -> str:
        return f"{self.attempt}/{self.number}"


def build_models(report: Report, database: Path, images: Path, output: Path, settings: SfmSettings, seed: int) -> None:
    """Map the database's verified pairs; `output` then holds what `read_built` and `final_model` read.

    The largest of the models that come out is the base. Where it lacks images, a second attempt goes on from it with
    a lower bar for registering one. The larger of the two is adjusted once more as a whole and is the final model.
    That adjustment is robust: a few per cent of wrong observations would otherwise weigh more than all right ones.
    """
    work = output.with_name(output.name + ".partial")
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    with pycolmap.Database.open(database) as opened:
        wanted = opened.num_images()
    registered = 0

    def count() -> None:
        nonlocal registered
        registered += 1
        report(min(registered, wanted))

    def attempt(name: str, base: Path | None, options: pycolmap.IncrementalPipelineOptions) -> None:
        folder = work / name
        folder.mkdir()
        models = pycolmap.incremental_mapping(
            database, images, folder, options, input_path=base or "", next_image_callback=count
        )
        found = [model for _, model in sorted(models.items()) if model.num_reg_images() >= _SMALLEST_MODEL]
        built.extend((_described(name, number, model), model) for number, model in enumerate(found))

    built: list[tuple[BuiltModel, pycolmap.Reconstruction]] = []
    options = _pipeline_options(settings, seed)
    attempt("incremental", None, options)
    if built and (largest := _largest(built)).num_reg_images() < wanted:
        base = work / "base"
        base.mkdir()
        largest.write_binary(base)
        options.multiple_models = False
        options.mapper.abs_pose_min_num_inliers = _EASIER_MIN_INLIERS
        attempt("continued", base, options)
    if built:
        final = _largest(built)
        (work / _FINAL).mkdir()
        final.write_binary(work / _FINAL)
        spread_px = float(np.median(np.abs(load_model(work / _FINAL, wanted).residual_px)))
        loss_px = max(_LOSS_WIDTH * spread_px, _NARROWEST_LOSS_PX)
        pycolmap.bundle_adjustment(final, _adjustment_options(settings, loss_px))
        final.update_point_3d_errors()
        final.extract_colors_for_all_images(images)
        final.write_binary(work / _FINAL)
        built = [
            (replace(_described(told.attempt, told.number, model), chosen=True, loss_px=loss_px), model)
            if model is final
            else (told, model)
            for told, model in built
        ]
    (work / _BUILT).write_text(json.dumps([asdict(told) for told, _ in built]), encoding="utf-8")
    shutil.rmtree(output, ignore_errors=True)
    work.rename(output)


def read_built(output: Path) -> list[BuiltModel]:
    """The models that `build_models` built, in the order in which it tried."""
    return [BuiltModel(**entry) for entry in json.loads((output / _BUILT).read_text(encoding="utf-8"))]


def final_model(output: Path) -> Path:
    """The folder of the chosen model; not there where no model was built."""
    return output / _FINAL


def _largest(built: list[tuple[BuiltModel, pycolmap.Reconstruction]]) -> pycolmap.Reconstruction:
    return max((model for _, model in built), key=lambda m: (m.num_reg_images(), m.compute_num_observations()))


def _described(attempt: str, number: int, model: pycolmap.Reconstruction) -> BuiltModel:
    return BuiltModel(
        attempt,
        number,
        model.num_reg_images(),
        model.num_points3D(),
        model.compute_num_observations(),
        model.compute_mean_track_length(),
        model.compute_mean_reprojection_error(),
    )


def _pipeline_options(settings: SfmSettings, seed: int) -> pycolmap.IncrementalPipelineOptions:
    options = pycolmap.IncrementalPipelineOptions()
    # On several threads two runs may differ in the last bits, and then in which points they keep; one thread repeats.
    options.num_threads = 1
    options.mapper.num_threads = 1
    options.random_seed = seed
    options.mapper.random_seed = seed
    options.triangulation.random_seed = seed
    options.min_model_size = _SMALLEST_MODEL
    options.extract_colors = False
    # A third of the time of COLMAP's own steps, poses as good (docs/sfm.md); the whole is adjusted to the end afterwards.
    options.ba_global_frames_ratio = options.ba_global_points_ratio = 2.0
    options.ba_global_max_num_iterations = 15
    options.ba_global_max_refinements = 1
    options.ba_local_max_refinements = 1
    options.ba_refine_focal_length = settings.refine_intrinsics
    options.ba_refine_extra_params = False
    options.mapper.abs_pose_refine_focal_length = settings.refine_intrinsics
    options.mapper.abs_pose_refine_extra_params = False
    return options


def _adjustment_options(settings: SfmSettings, loss_px: float) -> pycolmap.BundleAdjustmentOptions:
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = settings.refine_intrinsics
    options.refine_principal_point = False
    options.refine_extra_params = False
    options.print_summary = False
    options.ceres.solver_options.num_threads = 1
    # Mapping has adjusted the model already; what the robust loss changes is done in a few steps.
    options.ceres.solver_options.max_num_iterations = _FINAL_STEPS
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = loss_px
    return options
