"""`python -m groundwalk.export`: ground truth as other tools read it, or a regressor as a phone runs it."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import numpy as np
import pandas as pd
import typer

from groundwalk.export.dataset import (
    JPEG_QUALITY,
    MAX_APART_PX,
    Dataset,
    Images,
    load_dataset,
    numbers,
    with_georeference,
)
from groundwalk.export.dataset_card import people
from groundwalk.export.exporters import EXPORTERS
from groundwalk.runtime.bundle_file import MANIFEST
from groundwalk.store import DataRoot, UserError, progress
from groundwalk.store.cli import DataOption, ProfileOption
from groundwalk.store.files import file_names, fresh_folder, refuse_to_overwrite, write_json
from groundwalk.store.georeference import FILE
from groundwalk.store.hints import of_scene, setting_of
from groundwalk.store.images import verify_images
from groundwalk.store.inputs import held
from groundwalk.store.tables import CAMERA_COLUMNS, map_unit, scale_warning

_PHONE = "phone"  # of a regressor, where the others are of ground truth
_NOTE = "export.json"
_FRAMES = "frames.csv"
_PLACES = "georeference.csv"
_PLACE = [
    *("latitude_deg", "longitude_deg", "altitude_m", "east_m", "north_m", "up_m"),
    *("east_sd_m", "north_sd_m", "up_sd_m"),
]
_READ_FOR_TRUTH = ("import", "sfm", "align")
_READ_FOR_MODEL = ("import", "align", "train", "fuse")


def _format_id(name: str) -> str:
    """The id of an exporter; as a wrong choice among options where there is none."""
    if name == _PHONE or name in EXPORTERS or name in EXPORTERS.problems:
        return name if name == _PHONE else EXPORTERS.known(name)
    raise typer.BadParameter(f"{name!r} is not one of {', '.join([*EXPORTERS, _PHONE])}")


class ImagesOption(StrEnum):
    link = "link"
    copy = "copy"
    none = "none"


def export(
    scene: Annotated[str, typer.Option(help="The scene; its align stage has run.")],
    name: Annotated[
        str,
        typer.Option(
            "--format",
            callback=_format_id,
            metavar="FORMAT",
            help="The layout to write: colmap, splat, tum, ... for ground truth, phone for a regressor.",
        ),
    ],
    out: Annotated[Path, typer.Option(help="The folder to make.")],
    images: Annotated[
        ImagesOption,
        typer.Option(
            help="Link to the images, copy them, or write none. Images whose lens distortion a format can't hold "
            "are written undistorted instead of linked or copied."
        ),
    ] = ImagesOption.link,
    model: Annotated[
        str, typer.Option(help="With format phone: the regressor's id, as in the table train.models.")
    ] = "",
    licence: Annotated[
        str, typer.Option(help="The data set's licence, such as cc-by-4.0; format huggingface needs one.")
    ] = "",
    citation: Annotated[str, typer.Option(help="How to cite the data set, for its card.")] = "",
    georeference: Annotated[
        bool, typer.Option("--georeference", help="Give out where on earth the map is, too, where align knows it.")
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="Replace an earlier export in that folder.")] = False,
    profile: ProfileOption = "demo",
    data: DataOption = Path("data"),
) -> None:
    """Write ground truth as another tool reads it, or a regressor as a phone runs it.

    docs/how-to/export.md says what each format of ground truth can't hold. Frames without ground truth are left out;
    `frames.csv` lists every frame with its split, quality, image and camera; `export.json` says what the export is.
    docs/how-to/phone.md says what format phone writes.
    """
    if (name == _PHONE) != bool(model):
        raise UserError(
            f"format {name} needs the id of a regressor" if not model else f"format {name} is not of a regressor",
            where="--model",
            do="add --model PN, or another of the table train.models" if not model else "leave --model out",
        )
    root = DataRoot(data)
    scenes, stages = [scene, *root.leaves(root.scene(scene)[0])], _READ_FOR_MODEL if model else _READ_FOR_TRUTH
    with held(root, profile, scenes, stages) as refuse_changed:
        if model:
            _export_regressor(root, profile, scene, model, out, refuse_changed, force=force)
            return
        reads_images = images is not ImagesOption.none
        dataset = load_dataset(root, profile, scene, reads_images=reads_images)
        dataset = replace(dataset, licence=licence, citation=citation)
        if georeference:
            dataset = with_georeference(dataset, root.run(profile, scene, "align"))
        about = {"scene": scene, "profile": profile, "format": name, "licence": licence, "citation": citation}
        exporter = EXPORTERS.find(name)
        dataset = exporter.with_its_cameras(dataset)
        with _export_folder(out, _NOTE, force=force) as folder:
            with EXPORTERS.guard(name):
                placed = exporter.write(dataset, folder, images.value)
                if not isinstance(placed, list) or len(placed) != len(dataset.frames):
                    returned = f"{len(placed)} paths" if isinstance(placed, list) else f"a {type(placed).__name__}"
                    raise ValueError(f"write returned {returned}, expected a list of {len(dataset.frames)} image paths")
            count = _write_lists(dataset, placed, folder, about, images.value)
            refuse_changed()
            if reads_images:
                verify_images(root.captures(scene), root.run(profile, scene, "import"))
    excluded, elsewhere = len(dataset.excluded), len(dataset.frames) - count
    progress.console.print(
        f"{scene} as {name}: {count} frames"
        f"{f', {excluded} without ground truth excluded (see {_FRAMES})' if excluded else ''}"
        f"{f', {elsewhere} of further SfM models left out' if elsewhere else ''} → {out}",
        markup=False,
    )
    said = []
    if undistorted := dataset.undistorted:
        written = f", written as PNG or as JPEG of quality {JPEG_QUALITY}" if reads_images else ""
        said.append(
            f"{undistorted} images undistorted, as pinhole cameras see them, for {name}{written}; rolling shutter is "
            "not corrected"
        )
    if dataset.apart_px:
        said.append(
            f"one camera a frame: those of one device and lens differ by up to {dataset.apart_px:.1f} px in a "
            f"corner of the image, more than {MAX_APART_PX} px (focus, stabilisation); format splat has one a device"
        )
    if warning := scale_warning(map_unit(dataset.frames)):
        said.append(f"warning: {warning}")
    if dataset.simulated:
        said.append("the captures are simulated, and export.json says so")
    elif reads_images:
        advice = of_scene(setting_of("import", "blur = true"), root, scene)
        how = f" {advice} blurs them (docs/how-to/blur-faces.md)"
        said.append(people(dataset) + how * bool(dataset.frames["blurred_faces"].isna().any()))
    for line in said:
        progress.console.print(f"  {line}", markup=False)


def _export_regressor(
    data: DataRoot, profile: str, scene: str, model: str, out: Path, refuse_changed: Callable[[], None], *, force: bool
) -> None:
    # PyTorch, which ground truth doesn't need.
    from groundwalk.export.phone.bundle import write_bundle
    from groundwalk.export.regressor import load_regressor

    with _export_folder(out, MANIFEST, force=force) as folder:
        regressor = load_regressor(data, profile, scene, model)
        said = write_bundle(regressor, folder)
        refuse_changed()
    if regressor.simulated:
        said = [*said, f"the captures are simulated, and {MANIFEST} says so"]
    warnings = {leaf: scale_warning(unit) for leaf, unit in regressor.units.items()}
    said = [*(f"warning: {leaf}: {warning}" for leaf, warning in warnings.items() if warning), *said]
    for line in (f"{model} of {scene} as {_PHONE} → {out.absolute()}", *(f"  {line}" for line in said)):
        progress.console.print(line)


@contextmanager
def _export_folder(out: Path, note: str, *, force: bool) -> Iterator[Path]:
    """A folder that becomes `out` when the export is whole. UserError where that has files; with `force` an earlier
    export in it, which `note` tells, is replaced, never anything else."""
    out = out.absolute()
    refuse_to_overwrite(out, "exports", note, "format", force=force)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with fresh_folder(out) as folder:
            yield folder
    except OSError as error:
        # An error of a link names first what it leads to.
        where = error.filename2 or error.filename or out
        raise UserError("the export can't be written", where=where, found=error.strerror) from None


def _write_lists(dataset: Dataset, placed: list[str], folder: Path, about: dict[str, str], images: Images) -> int:
    """Write what the export is, and the list of all frames: exported ones with their images and these' cameras; returns
    how many are exported."""
    columns = ["frame_id", "session_id", "split", "t_ns", "clock", "quality", "reason"]
    frames = dataset.frames
    exported = frames[columns].assign(image=placed, **{n: frames[n] for n in ("width", "height", *CAMERA_COLUMNS[:4])})
    exported["distortion"] = [numbers(*coefficients) for coefficients in frames["distortion"]]
    listed = pd.concat([exported, dataset.excluded[columns].assign(image="")]).sort_values("frame_id")
    listed.astype({"width": "Int64", "height": "Int64"}).to_csv(folder / _FRAMES, index=False)
    if dataset.georeference is not None:
        dataset.georeference.write(folder / FILE)
        enu, sd, geodetic = dataset.georeference.places(dataset.map_T_cam[:, :3, 3])
        own = dataset.georeference.enu_S_map.scale * frames[["position_sd_m"]].astype(float).fillna(0.0).to_numpy()
        places = pd.DataFrame(np.hstack([geodetic, enu, np.hypot(sd, own)]), columns=_PLACE)
        pd.concat([exported[["frame_id", "image"]], places], axis=1).to_csv(folder / _PLACES, index=False)
    # Those of further SfM models, which a format may have no place for, have no path. Without images none needs one.
    written = frames[np.array(placed) != ""] if any(placed) else frames
    content = {
        **about,
        "simulated": dataset.simulated,
        "images": images,
        "people": people(dataset) if images != "none" else None,
        "undistorted_images": dataset.undistorted,
        "jpeg_quality": JPEG_QUALITY if dataset.undistorted else None,
        "frames": len(written),
        "left_out": len(frames) - len(written),
        "excluded": len(dataset.excluded),
        "by_split": written["split"].value_counts().sort_index().to_dict(),
        "by_quality": written["quality"].value_counts().sort_index().to_dict(),
        "map_origin": dataset.origin,
        "map": f"{dataset.world} before any turn that the format asks for",
        "files": file_names(folder),
    }
    write_json(folder / _NOTE, content)
    return len(written)
