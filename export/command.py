"""`python -m groundwalk.export`: ground truth in the layout of another tool or data set."""

import json
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import pandas as pd
import typer

from groundwalk.artefacts import DataRoot, UserError, progress
from groundwalk.artefacts.cli import DataOption, ProfileOption
from groundwalk.artefacts.files import fresh_folder, write_json
from groundwalk.artefacts.tables import CAMERA_COLUMNS
from groundwalk.export.dataset import JPEG_QUALITY, Dataset, Images, load_dataset, number
from groundwalk.export.exporters import EXPORTERS, written

_NOTE = "export.json"
_FRAMES = "frames.csv"


def _known(name: str) -> str:
    """The id of an exporter; as a wrong choice among options where there is none."""
    if name not in EXPORTERS and name not in EXPORTERS.problems:
        raise typer.BadParameter(f"{name!r} is not one of {', '.join(EXPORTERS)}")
    return EXPORTERS.known(name)


class ImagesOption(StrEnum):
    """What becomes of the images."""

    link = "link"
    copy = "copy"
    none = "none"


def export(
    scene: Annotated[str, typer.Option(help="A scene whose ground truth is there.")],
    name: Annotated[
        str,
        typer.Option("--format", callback=_known, metavar="FORMAT", help="The layout to write: colmap, tum, ..."),
    ],
    out: Annotated[Path, typer.Option(help="The folder to make.")],
    images: Annotated[
        ImagesOption,
        typer.Option(
            help="Link to the images, copy them, or leave them out. Images whose lens distortion a format can't hold "
            "are written undistorted instead of linked or copied."
        ),
    ] = ImagesOption.link,
    force: Annotated[bool, typer.Option("--force", help="Replace an earlier export in that folder.")] = False,
    profile: ProfileOption = "demo",
    data: DataOption = Path("data"),
) -> None:
    """Write ground truth as another tool reads it; docs/explanation/ground-truth.md says what each format can't hold.

    Frames without ground truth are left out; `frames.csv` lists every frame with its split, quality, image and camera;
    `export.json` says what the export is.
    """
    dataset = load_dataset(DataRoot(data), profile, scene)
    about = {"scene": scene, "profile": profile, "format": name}
    undistorted = write_export(dataset, name, out, images.value, about, force=force)
    left = len(dataset.left_out)
    progress.console.print(
        f"{scene} as {name}: {len(dataset.frames)} frames"
        f"{f', {left} without ground truth left out ({_FRAMES} says which)' if left else ''} → {out}",
        markup=False,
    )
    if undistorted:
        progress.console.print(
            f"  {name} has no place for their lens distortion: {undistorted} images undistorted, as those of pinholes"
            f"{f', written as PNG or as JPEG of quality {JPEG_QUALITY}' if images is not ImagesOption.none else ''}",
            markup=False,
        )
    if dataset.simulated:
        progress.console.print("  the captures are simulated, and export.json says so", markup=False)


def write_export(
    dataset: Dataset, format_name: str, out: Path, images: Images, about: dict[str, str], *, force: bool
) -> int:
    """Write an export to the folder `out`, which appears when it is whole; returns how many images were undistorted.

    Raises UserError where `out` is there; with `force` an earlier export in it is replaced, nothing else ever is.
    """
    out = out.absolute()
    _refuse_to_overwrite(out, force)
    coefficients = EXPORTERS.find(format_name).distortion_coefficients
    if coefficients is not None:
        dataset = dataset.without_distortion(coefficients)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with fresh_folder(out) as folder:
            placed = written(format_name, dataset, folder, images)
            listed = _listed(dataset, placed)
            listed.to_csv(folder / _FRAMES, index=False)
            write_json(
                folder / _NOTE,
                {
                    **about,
                    "simulated": dataset.simulated,
                    "images": images,
                    "undistorted_images": dataset.undistorted,
                    "jpeg_quality": JPEG_QUALITY if dataset.undistorted else None,
                    "frames": len(dataset.frames),
                    "left_out": len(dataset.left_out),
                    "by_split": dataset.frames["split"].value_counts().sort_index().to_dict(),
                    "by_quality": dataset.frames["quality"].value_counts().sort_index().to_dict(),
                    "map": f"{dataset.world} before any turn that the format asks for",
                },
            )
        return dataset.undistorted
    except OSError as error:
        raise UserError("the export can't be written", where=error.filename or out, found=error.strerror) from None


def _listed(dataset: Dataset, placed: list[str]) -> pd.DataFrame:
    """All frames, those that are exported with their images and these images' cameras."""
    columns = ["frame_id", "session_id", "split", "t_ns", "clock", "quality", "reason"]
    frames = dataset.frames
    exported = frames[columns].assign(image=placed, **{n: frames[n] for n in ("width", "height", *CAMERA_COLUMNS[:4])})
    exported["distortion"] = [" ".join(map(number, coefficients)) for coefficients in frames["distortion"]]
    listed = pd.concat([exported, dataset.left_out[columns].assign(image="")]).sort_values("frame_id")
    return listed.astype({"width": "Int64", "height": "Int64"})


def _refuse_to_overwrite(out: Path, force: bool) -> None:
    if not out.exists() or (out.is_dir() and not any(out.iterdir())):
        return
    if not _is_export(out):
        raise UserError(
            "the folder holds something else than an export",
            where=out,
            expected=f"a new or empty folder, or an earlier export with its {_NOTE}",
            do="name another folder with --out",
        )
    if not force:
        raise UserError("there is an export already", where=out, do="name another folder, or replace it with --force")


def _is_export(folder: Path) -> bool:
    try:
        return "format" in json.loads((folder / _NOTE).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
