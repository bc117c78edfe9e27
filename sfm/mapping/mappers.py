"""Mappers behind one interface: from a database of verified pairs to models, each in its gauge."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap

from groundwalk.geometry.poses import Array, inverse
from groundwalk.sfm.database import image_id, pose_of
from groundwalk.sfm.mapping.merging import merge_points
from groundwalk.sfm.plugins import MappingInput
from groundwalk.store.memory import give_back_freed_memory

MIN_MODEL_FRAMES = 3
_EXPLAINED_FRACTION = 0.001  # of an image's longer side
_ANY_COEFFICIENT = 1e9
# VIO's own errors over a few metres, seen from a few metres: first generous, then as strict as mapping is.
_ROUNDS_PX = (16.0, 8.0, 4.0)
_MIN_OBSERVATIONS = 30
_NO_MERGING_PX = 1e-9


def incremental_mapping(
    source: MappingInput, folder: Path, registered: Callable[[], None]
) -> list[pycolmap.Reconstruction]:
    """COLMAP's incremental mapping (Schönberger and Frahm, "Structure-from-motion revisited", CVPR 2016)."""
    options = pipeline_options(source)
    # Where people hardly walked, no first pair is exact, as its rays meet at small angles: then COLMAP's own limit.
    for limit_px in (options.mapper.init_max_error, pycolmap.IncrementalMapperOptions().init_max_error):
        options.mapper.init_max_error = limit_px
        models = pycolmap.incremental_mapping(
            source.database, source.images, folder, options, next_image_callback=registered
        )
        if listed := _listed(models):
            return listed
    return []


def continued(
    source: MappingInput,
    base: pycolmap.Reconstruction,
    folder: Path,
    registered: Callable[[], None],
    *,
    held: bool = False,
) -> list[pycolmap.Reconstruction]:
    """Incremental mapping that goes on from a model, with half the inliers needed to register an image. Images of a
    model that is `held` stay where they are, and needn't have a match."""
    start = folder / "base"
    start.mkdir(parents=True)
    base.write_binary(start)
    options = pipeline_options(source)
    options.multiple_models = False
    options.mapper.abs_pose_min_num_inliers //= 2
    options.fix_existing_frames = options.mapper.fix_existing_frames = options.load_all_images = held
    return _listed(
        pycolmap.incremental_mapping(
            source.database, source.images, folder, options, input_path=start, next_image_callback=registered
        )
    )


def from_poses(source: MappingInput, start_T_cam: Array, folder: Path) -> pycolmap.Reconstruction:
    """A model of the images that have a pose, start_T_cam (N, 4, 4; NaN for none): points triangulated by these poses
    and all adjusted freely, in rounds, first with generous limits. The poses are the start alone."""
    model = _of_poses(source, start_T_cam)
    options = pipeline_options(source)
    adjustment = pycolmap.BundleAdjustmentOptions(print_summary=False)
    adjustment.refine_focal_length = adjustment.refine_principal_point = adjustment.refine_extra_params = False
    adjustment.ceres.solver_options.num_threads = 1
    adjustment.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    for error_px in _ROUNDS_PX:
        options.triangulation.complete_max_reproj_error = options.triangulation.merge_max_reproj_error = error_px
        options.mapper.filter_max_reproj_error = error_px
        model = pycolmap.triangulate_points(model, source.database, source.images, folder, options=options)
        pycolmap.bundle_adjustment(model, adjustment)
    for image in list(model.images.values()):
        if image.num_points3D < _MIN_OBSERVATIONS:
            model.deregister_frame(image.frame_id)
    return model


def with_all_matches(source: MappingInput, model: pycolmap.Reconstruction, folder: Path) -> pycolmap.Reconstruction:
    """The poses of a model that was mapped by some matches, and the points of all."""
    sfm_T_cam = np.full((max(model.reg_image_ids()), 4, 4), np.nan)
    for i in model.reg_image_ids():
        sfm_T_cam[i - image_id(0)] = pose_of(model.image(i))
    options = pipeline_options(source)
    limit_px = options.triangulation.merge_max_reproj_error
    options.triangulation.merge_max_reproj_error = _NO_MERGING_PX
    options.ba_global_max_refinements = 0  # points are adjusted with the cameras, in less memory
    model = pycolmap.triangulate_points(
        _of_poses(source, sfm_T_cam), source.database, source.images, folder, options=options
    )
    give_back_freed_memory()
    merge_points(model, source.database, limit_px)
    model.update_point_3d_errors()
    give_back_freed_memory()
    return model


def _of_poses(source: MappingInput, sfm_T_cam: Array) -> pycolmap.Reconstruction:
    """A model of the images that have a pose (N, 4, 4; NaN for none), without points."""
    with pycolmap.Database.open(source.database) as opened:
        cameras = {camera.camera_id: camera for camera in opened.read_all_cameras()}
        images = {image.image_id: image for image in opened.read_all_images()}
    model = pycolmap.Reconstruction()
    for row in np.flatnonzero(np.isfinite(sfm_T_cam[:, 0, 0])).tolist():
        of_image = images[image_id(row)]
        if not model.exists_camera(of_image.camera_id):
            model.add_camera_with_trivial_rig(cameras[of_image.camera_id])
        image = pycolmap.Image(image_id=of_image.image_id, camera_id=of_image.camera_id, name=of_image.name)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(inverse(sfm_T_cam[row])[:3]))
    return model


def global_mapping(source: MappingInput, folder: Path, registered: Callable[[], None]) -> list[pycolmap.Reconstruction]:
    """COLMAP's global mapping (Pan et al., "Global structure-from-motion revisited", GLOMAP, ECCV 2024)."""
    options = pycolmap.GlobalPipelineOptions()
    options.num_threads = options.mapper.num_threads = 1
    mapper = options.mapper
    for part in (options, mapper, mapper.rotation_averaging, mapper.global_positioning, mapper.retriangulation):
        part.random_seed = source.seed
    options.mapper.global_positioning.use_gpu = False
    adjustment = options.mapper.bundle_adjustment
    adjustment.ceres.use_gpu = False
    adjustment.ceres.solver_options.num_threads = 1
    adjustment.refine_focal_length = adjustment.refine_extra_params = False
    options.min_model_size = MIN_MODEL_FRAMES
    return _listed(pycolmap.global_mapping(source.database, source.images, folder, options))


def pipeline_options(source: MappingInput) -> pycolmap.IncrementalPipelineOptions:
    options = pycolmap.IncrementalPipelineOptions()
    # On several threads two runs may differ in the last bits, and then in which points they keep; one thread repeats.
    options.num_threads = options.mapper.num_threads = 1
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = source.seed
    options.min_model_size = MIN_MODEL_FRAMES
    options.extract_colors = False
    # A fraction of the time of COLMAP's own steps, poses as good; the whole is adjusted at the end.
    options.ba_global_frames_ratio = options.ba_global_points_ratio = 2.0
    options.ba_global_max_refinements = 1
    options.ba_global_max_num_iterations = 2
    options.ba_local_max_refinements = 1
    options.ba_local_max_num_iterations = 10
    # What a match of the first pair may be off by, in pixels. Two poses explain the matches of a facade within COLMAP's
    # 4 px, and of these RANSAC takes either: a model that begins with the wrong one folds, however good all other
    # matches are. Within a pixel one of them remains.
    with pycolmap.Database.open(source.database) as opened:
        longest = max(max(camera.width, camera.height) for camera in opened.read_all_cameras())
    options.mapper.init_max_error = max(1.0, _EXPLAINED_FRACTION * longest)
    # People walk forward. A first pair still needs rays that meet at a wide enough angle.
    options.mapper.init_max_forward_motion = 1.0
    options.ba_refine_focal_length = options.ba_refine_extra_params = False
    options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = False
    # Lenses stay as they are given. Fisheye ones have coefficients above 1, which COLMAP takes for diverged; its global
    # mapper has no such option, and registers nothing with them.
    options.max_extra_param = options.mapper.max_extra_param = _ANY_COEFFICIENT
    return options


def _listed(models: dict[int, pycolmap.Reconstruction]) -> list[pycolmap.Reconstruction]:
    return [model for _, model in sorted(models.items()) if model.num_reg_images() >= MIN_MODEL_FRAMES]
