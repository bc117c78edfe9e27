"""What a data set says of itself, by what import, sfm and align wrote: a card for people, Croissant for programs."""

from collections import Counter
from collections.abc import Mapping
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from groundwalk.export.dataset import Dataset
from groundwalk.store.choices import MapUnit, PoseSource, QualityClass
from groundwalk.store.files import sha256_of
from groundwalk.store.tables import map_unit

_LIMITS = (
    "Ground truth comes from structure from motion on the images themselves, held against odometry or a data set's own "
    "poses; frames that it refuses are missing, so that what is left is easier than the capture. Poses are of the "
    "middle row of an image; rolling shutter is not undone."
)
_USE = "Training and testing of visual localisation: camera pose from an image, within this place."
# The context that Croissant 1.0 prescribes.
_CROISSANT_TERMS = (
    "citeAs", "column", "equivalentProperty", "extract", "field", "fileProperty", "fileObject", "fileSet",
    "format", "includes", "isLiveDataset", "jsonPath", "key", "md5", "parentField", "path", "recordSet",
    "references", "regex", "repeated", "replace", "samplingRate", "separator", "source", "subField",
    "transform"
)  # fmt: skip
_CONTEXT: dict[str, Any] = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    **{name: f"cr:{name}" for name in _CROISSANT_TERMS},
    "conformsTo": "dct:conformsTo",
    "cr": "http://mlcommons.org/croissant/",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "dct": "http://purl.org/dc/terms/",
    "examples": {"@id": "cr:examples", "@type": "@json"},
    "sc": "https://schema.org/",
}
_TYPES = {"image": "sc:ImageObject", "t_ns": "sc:Integer", "width": "sc:Integer", "height": "sc:Integer"}
_TEXT = ("frame_id", "session_id", "clock", "quality", "reason")
_LISTS = ("distortion", "position", "quaternion", "covariance")


def card(dataset: Dataset, files: Mapping[str, int], columns: Mapping[str, str]) -> str:
    """README.md with the hub's YAML at its top; `files` are frames by file."""
    splits = Counter[str]()
    for path, count in files.items():
        splits[_split_of(path)] += count
    listed = "\n".join(f"  - split: {name}\n    path: data/{name}-*.parquet" for name in splits)
    reasons = dataset.excluded["reason"].value_counts()
    refused = "".join(f"\n- {count}: {reason}" for reason, count in reasons.items()) or "\n- none"
    described = "\n".join(f"| `{name}` | {text} |" for name, text in columns.items())
    size = next(label for bound, label in _SIZES if len(dataset.frames) < bound)
    return f"""---
license: {dataset.licence}
pretty_name: {dataset.scene}
size_categories:
- {size}
tags:
- visual-localization
- camera-pose
configs:
- config_name: default
  data_files:
{listed}
---
# {dataset.scene}

{_origin(dataset)} {len(dataset.frames)} images with their camera poses in one map ({dataset.world}):
{", ".join(f"{name} {count}" for name, count in splits.items())}. `frames.csv` lists every frame of the capture.

```python
from datasets import load_dataset

frames = load_dataset("<this folder>", split="train")
```

## How it was captured

{_captured(dataset)}

## How good the poses are

{_quality(dataset)}

{len(dataset.excluded)} of {len(dataset.frames) + len(dataset.excluded)} frames got no ground truth and are left out:
{refused}

## Columns

| column | meaning |
|---|---|
{described}

## People and places

{_privacy(dataset)}

## Use and limits

{_USE} {_LIMITS}

## Licence and citation

Licence: {dataset.licence}. {f"Cite as: {dataset.citation}" if dataset.citation else "No citation was given."}
Made with groundwalk.
"""


_SIZES = ((1_000, "n<1K"), (10_000, "1K<n<10K"), (100_000, "10K<n<100K"), (np.inf, "100K<n<1M"))


def croissant(dataset: Dataset, folder: Path, files: Mapping[str, int], columns: Mapping[str, str]) -> dict[str, Any]:
    """Croissant 1.0 as JSON-LD: the files, a record set a split, and what the extension for responsible AI asks for."""
    distribution, record_sets = [], []
    for path in files:
        distribution.append(
            {
                "@type": "cr:FileObject",
                "@id": path,
                "name": Path(path).stem,
                "contentUrl": path,
                "encodingFormat": "application/x-parquet",
                "contentSize": f"{(folder / path).stat().st_size} B",
                "sha256": sha256_of(folder / path),
            }
        )
    for split in dict.fromkeys(map(_split_of, files)):
        distribution.append(
            {
                "@type": "cr:FileSet",
                "@id": f"{split}-files",
                "name": f"{split}-files",
                "encodingFormat": "application/x-parquet",
                "includes": f"data/{split}-*.parquet",
            }
        )
        record_sets.append(
            {
                "@type": "cr:RecordSet",
                "@id": split,
                "name": split,
                "field": [_field(split, name, text) for name, text in columns.items()],
            }
        )
    return {
        "@context": _CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": ["http://mlcommons.org/croissant/1.0", "http://mlcommons.org/croissant/RAI/1.0"],
        "name": dataset.scene,
        "description": f"{_origin(dataset)} {len(dataset.frames)} images with camera poses in one map.",
        "license": dataset.licence,
        "version": "1.0.0",
        "datePublished": date.today().isoformat(),
        **({"citeAs": dataset.citation} if dataset.citation else {}),
        "rai:dataCollection": _captured(dataset),
        "rai:dataCollectionType": "Simulation" if dataset.simulated else "Direct measurement",
        "rai:dataCollectionMissingData": f"{len(dataset.excluded)} frames without ground truth are left out.",
        "rai:dataAnnotationProtocol": _quality(dataset),
        "rai:machineAnnotationTools": "groundwalk",
        "rai:dataUseCases": _USE,
        "rai:dataLimitations": _LIMITS,
        "rai:dataBiases": "One place, by the phones and at the times that it was captured.",
        "rai:personalSensitiveInformation": _privacy(dataset),
        "distribution": distribution,
        "recordSet": record_sets,
    }


def _split_of(path: str) -> str:
    return Path(path).name.split("-")[0]


def _field(split: str, name: str, text: str) -> dict[str, Any]:
    return {
        "@type": "cr:Field",
        "@id": f"{split}/{name}",
        "name": name,
        "description": text,
        "dataType": _TYPES.get(name, "sc:Text" if name in _TEXT else "sc:Float"),
        **({"repeated": True} if name in _LISTS else {}),
        "source": {
            "fileSet": {"@id": f"{split}-files"},
            "extract": {"column": name},
            **({"transform": {"jsonPath": "bytes"}} if name == "image" else {}),
        },
    }


def _origin(dataset: Dataset) -> str:
    return "SIMULATED: these images were rendered, not taken." if dataset.simulated else "Measured, not simulated."


def _captured(dataset: Dataset) -> str:
    sessions = dataset.sessions.groupby(["format", "device"], sort=True)
    parts = [
        f"{len(rows)} session{'s' * (len(rows) != 1)} in format {kind}{f' by {device}' if device else ''}, "
        f"{int(rows['frames'].sum())} frames"
        for (kind, device), rows in sessions
    ]
    return f"{'; '.join(parts)}. Import chose the frames and the splits ({dataset.split_by})."


def _quality(dataset: Dataset) -> str:
    frames, classes = dataset.frames, [name for name in QualityClass if name != QualityClass.NONE]
    counts = ", ".join(f"{name} {int((frames['quality'] == name).sum())}" for name in classes)
    sources = ", ".join(sorted(set(frames["scale_source"].dropna())))
    position, rotation = (frames[name].median() for name in ("position_sd_m", "rotation_sd_deg"))
    unit = map_unit(frames)
    length = f"{1000 * position:.2g} mm" if unit is MapUnit.METRE else f"{position:.2g} {unit.symbol}"
    sigma = f"Standard errors, median: {length} and {rotation:.2g} degrees in the least certain axis"
    if pd.isna(position):
        sigma = "Standard errors aren't known"
    if (dataset.sessions["pose_source"] == PoseSource.NONE).all():
        sigma = "Nothing but the images checks the map's shape, so no standard error is said"
    stated = int(frames["covariance"].notna().sum())
    having = "Each frame has its" if stated == len(frames) else f"{stated} of {len(frames)} frames have their"
    return f"Frames by quality class: {counts}. {sigma}. Metric scale: {sources}. {having} 6x6 covariance."


def people(dataset: Dataset) -> str:
    """Whether people who are in the images were looked for."""
    looked = dataset.frames["blurred_faces"].notna()
    if dataset.simulated:
        return "The images show a simulated place without people."
    if not looked.any():
        return "Nobody looked for faces and licence plates: people who are in the images can be recognised."
    faces, plates = (int(dataset.frames[name].sum()) for name in ("blurred_faces", "blurred_plates"))
    unblurred = f" {int((~looked).sum())} images were not searched." if not looked.all() else ""
    return (
        f"{faces} faces and {plates} licence plates were blurred; detectors miss some faces, and look for no plates."
        f"{unblurred}"
    )


def _privacy(dataset: Dataset) -> str:
    """What the data set says of people, and of where on earth it was captured."""
    if dataset.georeference is not None:
        place = "georeference.json and georeference.csv say where on earth the place is"
        return f"{people(dataset)} {place} ({dataset.georeference.describe()})."
    said = "Positions by GPS were never read."
    if dataset.reads_gps:
        said = "Positions by GPS were read; neither they nor where on earth the map is are in this data set."
    if dataset.origin is not None and any(dataset.origin):
        said += " map_origin in export.json leads back to the coordinates of the data set that the poses are from."
    return f"{people(dataset)} {said} Images carry no metadata such as EXIF."
