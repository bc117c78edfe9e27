"""`python -m groundwalk.export`: ground truth as other tools read it, or a regressor as a phone runs it."""

from collections.abc import Callable
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import pandas as pd
import typer

from groundwalk.export.dataset import JPEG_QUALITY, Dataset, Images, load_dataset, number
from groundwalk.export.exporters import EXPORTERS, MODEL_EXPORTERS
from groundwalk.store import DataRoot, UserError, progress
from groundwalk.store.cli import DataOption, ProfileOption
from groundwalk.store.files import file_names, fresh_folder, refuse_to_overwrite, write_json
from groundwalk.store.images import verify_images
from groundwalk.store.inputs import held
from groundwalk.store.tables import CAMERA_COLUMNS

_NOTE = "export.json"
_FRAMES = "frames.csv"
_READ_FOR_TRUTH = ("import", "sfm", "align")
_READ_FOR_MODEL = ("import", "align", "train", "fuse")


def _format_id(name: str) -> str:
    """The id of an exporter; as a wrong choice among options where there is none."""
    if name in EXPORTERS or name in EXPORTERS.problems:
        return EXPORTERS.known(name)
    if name in MODEL_EXPORTERS or name in MODEL_EXPORTERS.problems:
        return MODEL_EXPORTERS.known(name)
    raise typer.BadParameter(f"{name!r} is not one of {', '.join([*EXPORTERS, *MODEL_EXPORTERS])}")


class ImagesOption(StrEnum):
    """What becomes of the images."""

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
            help="The layout to write: colmap, tum, ... for ground truth, phone for a regressor.",
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
    force: Annotated[bool, typer.Option("--force", help="Replace an earlier export in that folder.")] = False,
    profile: ProfileOption = "demo",
    data: DataOption = Path("data"),
) -> None:
    """Write ground truth as another tool reads it, or a regressor as a phone runs it.

    docs/how-to/export.md says what each format of ground truth can't hold. Frames without ground truth are left out;
    `frames.csv` lists every frame with its split, quality, image and camera; `export.json` says what the export is.
    docs/how-to/phone.md says what format phone writes.
    """
    if (name in MODEL_EXPORTERS) != bool(model):
        raise UserError(
            f"format {name} needs the id of a regressor" if not model else f"format {name} is not of a regressor",
            where="--model",
            do="add --model PN, or another of the table train.models" if not model else "leave --model out",
        )
    root = DataRoot(data)
    scenes, stages = [scene, *root.leaves(root.scene(scene)[0])], _READ_FOR_MODEL if model else _READ_FOR_TRUTH
    with held(root, profile, scenes, stages) as refuse_changed:
        if model:
            _export_model(root, profile, scene, model, name, out, refuse_changed, force=force)
            return
        reads_images = images is not ImagesOption.none
        dataset = load_dataset(root, profile, scene, reads_images=reads_images)
        dataset = replace(dataset, licence=licence, citation=citation)
        about = {"scene": scene, "profile": profile, "format": name, "licence": licence, "citation": citation}

        def refuse_any_changed() -> None:
            refuse_changed()
            if reads_images:
                verify_images(root.captures(scene), root.run(profile, scene, "import"))

        undistorted = write_export(dataset, name, out, images.value, about, refuse_any_changed, force=force)
    excluded = len(dataset.excluded)
    progress.console.print(
        f"{scene} as {name}: {len(dataset.frames)} frames"
        f"{f', {excluded} without ground truth excluded (see {_FRAMES})' if excluded else ''} → {out}",
        markup=False,
    )
    if undistorted:
        progress.console.print(
            f"  {name} can't hold lens distortion: {undistorted} images undistorted, as those of pinholes"
            f"{f', written as PNG or as JPEG of quality {JPEG_QUALITY}' if images is not ImagesOption.none else ''}",
            markup=False,
        )
    if dataset.simulated:
        progress.console.print("  the captures are simulated, and export.json says so")


def _export_model(
    data: DataRoot,
    profile: str,
    scene: str,
    model: str,
    name: str,
    out: Path,
    refuse_changed: Callable[[], None],
    *,
    force: bool,
) -> None:
    from groundwalk.export.regressor import load_regressor  # PyTorch, which ground truth doesn't need

    exporter, out = MODEL_EXPORTERS.find(name), out.absolute()
    refuse_to_overwrite(out, "exports", exporter.note, "format", force=force)
    regressor = load_regressor(data, profile, scene, model)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with fresh_folder(out) as folder, MODEL_EXPORTERS.guard(name):
            said = exporter.write(regressor, folder)
            refuse_changed()
    except OSError as error:
        raise _not_written(error, out) from None
    progress.console.print(f"{model} of {scene} as {name} → {out}")
    for line in said:
        progress.console.print(f"  {line}")
    if regressor.simulated:
        progress.console.print(f"  the captures are simulated, and {exporter.note} says so")


def write_export(
    dataset: Dataset,
    format_name: str,
    out: Path,
    images: Images,
    about: dict[str, str],
    refuse_changed: Callable[[], None],
    *,
    force: bool,
) -> int:
    """Write an export to the folder `out`, which appears when it is whole; returns how many images were undistorted.

    Raises UserError where `out` has files; with `force` an earlier export in it is replaced, never anything else.
    `refuse_changed` is called before it appears, and raises UserError where what was exported isn't there any more.
    """
    out = out.absolute()
    refuse_to_overwrite(out, "exports", _NOTE, "format", force=force)
    exporter = EXPORTERS.find(format_name)
    if exporter.distortion_coefficients is not None:
        dataset = dataset.without_distortion(exporter.distortion_coefficients)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with fresh_folder(out) as folder:
            with EXPORTERS.guard(format_name):
                placed = exporter.write(dataset, folder, images)
                if not isinstance(placed, list) or len(placed) != len(dataset.frames):
                    returned = f"{len(placed)} paths" if isinstance(placed, list) else f"a {type(placed).__name__}"
                    raise ValueError(f"write returned {returned}, expected a list of {len(dataset.frames)} image paths")
            all_frames = _all_frames(dataset, placed)
            all_frames.to_csv(folder / _FRAMES, index=False)
            write_json(
                folder / _NOTE,
                {
                    **about,
                    "simulated": dataset.simulated,
                    "images": images,
                    "undistorted_images": dataset.undistorted,
                    "jpeg_quality": JPEG_QUALITY if dataset.undistorted else None,
                    "frames": len(dataset.frames),
                    "excluded": len(dataset.excluded),
                    "by_split": dataset.frames["split"].value_counts().sort_index().to_dict(),
                    "by_quality": dataset.frames["quality"].value_counts().sort_index().to_dict(),
                    "map_origin": dataset.origin,
                    "map": f"{dataset.world} before any turn that the format asks for",
                    "files": file_names(folder),
                },
            )
            refuse_changed()
        return dataset.undistorted
    except OSError as error:
        raise _not_written(error, out) from None


def _not_written(error: OSError, out: Path) -> UserError:
    # An error of a link names first what it leads to.
    return UserError(
        "the export can't be written", where=error.filename2 or error.filename or out, found=error.strerror
    )


def _all_frames(dataset: Dataset, placed: list[str]) -> pd.DataFrame:
    """All frames, exported ones with their images and these images' cameras."""
    columns = ["frame_id", "session_id", "split", "t_ns", "clock", "quality", "reason"]
    frames = dataset.frames
    exported = frames[columns].assign(image=placed, **{n: frames[n] for n in ("width", "height", *CAMERA_COLUMNS[:4])})
    exported["distortion"] = [" ".join(map(number, coefficients)) for coefficients in frames["distortion"]]
    frames = pd.concat([exported, dataset.excluded[columns].assign(image="")]).sort_values("frame_id")
    return frames.astype({"width": "Int64", "height": "Int64"})
