"""hloc: what its scripts of localising take. `reference/` is COLMAP's model of the frames that aren't for testing,
`queries_with_intrinsics.txt` the camera of each test image, `queries_poses.txt` their poses as its results have them.

Format: https://github.com/cvg/Hierarchical-Localization (names without blanks; a camera is COLMAP's model, width,
height and parameters; a pose is world to camera, quaternion w first). The world is the map: metric, +y up.
"""

from dataclasses import replace
from pathlib import Path

from groundwalk.export.colmap import model_in_map, names_by_frame, write_model
from groundwalk.export.dataset import Dataset, Images, number
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
    write_model(model_in_map(replace(largest, frame_ids=reference)), folder / "reference")
    model = model_in_map(largest)
    names, by_name = names_by_frame(model), {image.name: image for image in model.images.values()}
    cameras, poses = list[str](), list[str]()
    for name in (names[frame_id] for frame_id in queries):
        image = by_name[name]
        camera, cam_T_map = model.camera(image.camera_id), image.cam_from_world()
        size = f"{camera.width} {camera.height}"
        cameras.append(" ".join([name, camera.model.name, size, *map(number, camera.params)]))
        x, y, z, w = cam_T_map.rotation.quat
        poses.append(" ".join([name, *map(number, (w, x, y, z, *cam_T_map.translation))]))
    for file, lines in (("queries_with_intrinsics.txt", cameras), ("queries_poses.txt", poses)):
        (folder / file).write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")
    placed = []
    for source, frame_id in zip(dataset.images, dataset.frames["frame_id"], strict=True):
        placed.append(f"images/{names[frame_id]}" if frame_id in names else "")
        if placed[-1]:
            source.place(folder / placed[-1], images)
    return placed
