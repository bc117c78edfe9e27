"""Golden queries: images with what each step of a bundle makes of them, to compare a port with."""

import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from groundwalk.export.phone.inputs import PhoneInputs
from groundwalk.runtime.bundle_file import GOLDEN
from groundwalk.store.files import write_json

_QUERIES = 3
# Resampling rounds differently from one build of OpenCV to another.
_MEAN_LEVELS, _MEAN_NORMALISED = 0.5, 0.02
_FP32 = {"position_m": 2e-3, "rotation_deg": 0.05}
_OF_MEDIAN = 0.1  # of the regressor's error: integers round differently from one processor to another

Network = Callable[[NDArray[np.float32]], Mapping[str, NDArray[Any]]]


def write_golden(
    inputs: PhoneInputs, folder: Path, networks: Mapping[str, Network], median_error: tuple[float, float]
) -> None:
    """Write golden/: some frames' images, the output of each step and of each network; median_error: m, degrees."""
    target = (folder / GOLDEN).parent
    target.mkdir()
    rows = inputs.spread("test", _QUERIES) or inputs.spread("val", _QUERIES)
    queries = [_query(inputs, row, number, target, networks) for number, row in enumerate(rows)]
    names = [step["step"] for step in queries[0]["steps"]]
    steps = {name: _MEAN_NORMALISED if name == "normalise" else _MEAN_LEVELS for name in names}
    loose = {n: max(least, _OF_MEDIAN * error) for (n, least), error in zip(_FP32.items(), median_error, strict=True)}
    limits = {name: _FP32 if name == "fp32" else loose for name in networks}
    write_json(folder / GOLDEN, {"tolerances": {"steps": steps, "networks": limits}, "queries": queries})


def _query(inputs: PhoneInputs, row: int, number: int, target: Path, networks: Mapping[str, Network]) -> dict[str, Any]:
    file = Path(inputs.regressor.frames["file"].iloc[row])
    image = f"{number}{file.suffix.lower()}"
    shutil.copyfile(file, target / image)
    query = inputs.query(row)
    steps, tensor = [], np.empty(0, np.float32)
    for index, (name, tensor) in enumerate(inputs.preprocessing.run(query), start=1):
        steps.append({"step": name, "file": f"{number}_{index}_{name}.npy"})
        np.save(target / steps[-1]["file"], tensor)
    return {
        "image": image,
        "intrinsics": {name: getattr(query.camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")},
        "gravity": None if query.gravity is None else query.gravity.tolist(),
        "steps": steps,
        "outputs": {
            name: {key: value[0].tolist() for key, value in run(tensor).items()} for name, run in networks.items()
        },
    }
