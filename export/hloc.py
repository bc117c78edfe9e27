"""hloc: what its scripts of localising take. `reference/` is COLMAP's model of the frames that aren't for testing,
`queries_with_intrinsics.txt` the camera of each test image, `queries_poses.txt` their poses as its results have them.

Format: https://github.com/cvg/Hierarchical-Localization (names without blanks; a camera is COLMAP's model, width,
height and parameters; a pose is world to camera, quaternion w first). The world is the map: metric, +y up.
"""

from dataclasses import replace
from pathlib import Path

from groundwalk.export.colmap import camera_fields, model_in_map, place_images, write_model
from groundwalk.export.dataset import Dataset, Images, number
from groundwalk.geometry.poses import inverse, tq_from_pose
from groundwalk.store import UserError
from groundwalk.store.hints import setting_of


def write_hloc(dataset: Dataset, folder: Path, images: Images) -> list[str]:
    """Write the layout; returns the frames' image paths, "" for those outside of the largest of SfM's models, which is
    the only one that hloc takes. UserError where all of its frames are for testing, or none is."""
    largest, in_test = dataset.models[0], set(dataset.frames["frame_id"][dataset.in_test])
    queries = [frame_id for frame_id in largest.frame_ids if frame_id in in_test]
    reference = [frame_id for frame_id in largest.frame_ids if frame_id not in in_test]
    if not queries or not reference:
        raise UserError(
            "hloc localises test frames in a map of the others",
            found=f"{len(queries)} test frames and {len(reference)} others in the largest model",
            do=f"split the scene: {setting_of('import', 'split_by')}",
        )
    names = dataset.image_names
    write_model(model_in_map(dataset, replace(largest, frame_ids=reference), names), folder / "reference")
    cameras, poses = list[str](), list[str]()
    position, quaternion = tq_from_pose(inverse(dataset.map_T_cam))
    all_cameras, row_of = dataset.cameras, {frame_id: row for row, frame_id in enumerate(dataset.frames["frame_id"])}
    for row in (row_of[frame_id] for frame_id in queries):
        cameras.append(" ".join([names[row], *camera_fields(all_cameras[row])]))
        x, y, z, w = quaternion[row]
        poses.append(" ".join([names[row], *map(number, (w, x, y, z, *position[row]))]))
    for file, lines in (("queries_with_intrinsics.txt", cameras), ("queries_poses.txt", poses)):
        (folder / file).write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")
    of_largest = dataset.frames["frame_id"].isin(largest.frame_ids)
    listed = [name if is_in else "" for name, is_in in zip(names, of_largest, strict=True)]
    return place_images(dataset, folder, listed, images)
