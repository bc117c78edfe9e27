"""The bundle of a trained regressor: all that a phone needs, in one folder (docs/reference/bundle-format.md)."""

import platform
from collections.abc import Callable, Mapping
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from groundwalk.export.phone.inputs import PhoneInputs
from groundwalk.export.phone.networks import PACKAGE, write_coreml, write_onnx
from groundwalk.export.phone.quantisation import HeldOut, Quantised, write_int8
from groundwalk.export.phone.readme import readme
from groundwalk.export.regressor import TrainedRegressor
from groundwalk.geometry.poses import quaternion_from_matrix, rotation_angle
from groundwalk.runtime.bundle import matrix_of, network_of
from groundwalk.runtime.bundle_file import ERRORS, FRAME, GOLDEN, PREPROCESSING, write_manifest
from groundwalk.scoring.errors import position_error, rotation_error_deg, within_bounds
from groundwalk.store import UserError, progress
from groundwalk.store.files import write_json
from groundwalk.store.images import without_metadata

_CALIBRATION, _HELD_OUT, _MIN_HELD_OUT = 48, 64, 16
_AS_TRAINED_M, _AS_TRAINED_DEG = 0.01, 0.2
_QUERIES = 3
# Resampling rounds differently from one build of OpenCV to another.
_MEAN_LEVELS, _MEAN_NORMALISED = 0.5, 0.02
_FP32 = {"position_m": 2e-3, "rotation_deg": 0.05}
_OF_MEDIAN = 0.1  # of the regressor's error: integers round differently from one processor to another

Network = Callable[[NDArray[np.float32]], Mapping[str, NDArray[Any]]]


def write_bundle(regressor: TrainedRegressor, folder: Path) -> list[str]:
    """Write the bundle into an empty folder; returns what to tell the user.

    UserError where a package that exporting needs isn't there, or the exported network doesn't predict what training
    did.
    """
    inputs = PhoneInputs(regressor)
    fp32, int8 = folder / "fp32.onnx", folder / "int8.onnx"
    write_onnx(regressor.trained, *inputs.input_size, fp32)
    _check_as_trained(inputs, fp32)
    calibration = [inputs.tensor(row) for row in inputs.spread("train", _CALIBRATION)]
    progress.console.print("quantising: measuring which parts gain by it")
    # Frames that the network wasn't trained on, with some that it was where these are few.
    rows = inputs.spread("val", _HELD_OUT)
    rows += inputs.spread("train", _HELD_OUT - len(rows)) if len(rows) < _MIN_HELD_OUT else []
    quaternion = quaternion_from_matrix(np.array([inputs.seen(row) for row in rows]))
    held_out = HeldOut([inputs.tensor(row) for row in rows], regressor.map_T_cam[rows, :3, 3], quaternion)
    quantised = write_int8(fp32, int8, calibration, held_out)
    networks = {name: file for name, file in (("fp32", fp32), ("int8", int8)) if file.is_file()}
    coreml = write_coreml(regressor.trained, *inputs.input_size, folder)
    errors = _errors(regressor)
    write_json(folder / PREPROCESSING, asdict(inputs.preprocessing))
    write_json(folder / FRAME, frame_of(regressor))
    if errors:
        write_json(folder / ERRORS, errors)
    median = errors.get("position_median_m", 0.0), errors.get("rotation_median_deg", 0.0)
    write_golden(inputs, folder, {name: network_of(file, 1) for name, file in networks.items()}, median)
    notes = _notes(quantised, coreml)
    about = {
        "model": regressor.model,
        "label": regressor.card["label"] or regressor.model,
        "scenes": list(regressor.scenes),
        "profile": regressor.profile,
        "simulated": regressor.simulated,
        # Empty cells of a table without any text are read as NaN.
        "reduced": regressor.card["reduced"] if isinstance(regressor.card["reduced"], str) else "",
        "written_by": f"groundwalk {version('groundwalk')}",
        "network": "int8" if "int8" in networks and quantised.is_faster else "fp32",
        "networks": {name: {"file": file.name, "bytes": file.stat().st_size} for name, file in networks.items()},
        "coreml": PACKAGE if not coreml else None,
        "quantisation": {**asdict(quantised), "processor": platform.processor() or platform.machine()},
        "notes": notes,
    }
    text = readme(about, inputs.preprocessing, errors, regressor.units.values())
    (folder / "README.md").write_text(text, encoding="utf-8")
    write_manifest(folder, about)
    sizes = ", ".join(f"{name} {file.stat().st_size / 2**20:.1f} MiB" for name, file in networks.items())
    return [f"networks: {sizes}; recommended: {about['network']}", *notes]


def frame_of(regressor: TrainedRegressor) -> dict[str, Any]:
    """What the poses mean: the content of frame.json."""
    return {
        "pose": "map_T_cam takes camera coordinates to the map: position in the map, quaternion x, y, z, w",
        "maps": regressor.worlds,
        "camera": {"x": "right", "y": "down", "z": "forward", "of": "the image as the sensor delivers it"},
        "arkit_camera": "x right, y up, z backward: multiply map_T_cam from the right by diag(1, -1, -1, 1)",
        "covariance": "of (rotation, position) in the map's axes, rad and the map's unit, 6x6 row-major",
    }


def _check_as_trained(inputs: PhoneInputs, fp32: Path) -> None:
    """UserError where the network, given frames as training was, doesn't predict what training's tables have."""
    run, regressor = network_of(fp32, 1), inputs.regressor
    for row in inputs.spread("train", 2):
        made, before = run(inputs.tensor_as_trained(row)), regressor.predicted[row]
        rotation = inputs.preprocessing.camera_rotation(matrix_of(made["quaternion"][0]), inputs.query(row).gravity)
        metres = float(np.linalg.norm(made["position"][0] - before[:3, 3]))
        degrees = float(np.degrees(rotation_angle(rotation.T @ before[:3, :3])))
        if not (metres < _AS_TRAINED_M and degrees < _AS_TRAINED_DEG):
            raise UserError(
                f"the exported network of {regressor.model} doesn't predict what training did",
                where=regressor.frames["file"].iloc[row],
                expected=f"less than {_AS_TRAINED_M} m and {_AS_TRAINED_DEG} degrees between them",
                found=f"{metres:.3f} m and {degrees:.2f} degrees",
                do="run the stage train again; where it stays so, the network doesn't export faithfully",
            )


def _errors(regressor: TrainedRegressor) -> dict[str, Any]:
    """Errors of training's predictions on the test frames, and how honest their covariances are; {} without any. Frames
    that the network took for another scene's, in whose map the answers are, are counted alone."""
    tested = regressor.rows("test")
    tested = tested[np.isfinite(regressor.predicted[tested]).all(axis=(1, 2))]
    in_its_map = regressor.frames["picked_scene"] == regressor.frames["scene"]
    rows = tested[in_its_map.to_numpy(bool)[tested]]
    if not len(rows):
        return {}
    poses = regressor.predicted[rows], regressor.map_T_cam[rows]
    content: dict[str, Any] = {"frames": len(rows), "of": "the network in float32 on the scene's test frames"}
    content["frames_of_another_scene"] = len(tested) - len(rows)
    for name, values in (("position_{}_m", position_error(*poses)), ("rotation_{}_deg", rotation_error_deg(*poses))):
        content |= {name.format("median"): float(np.median(values)), name.format("mean"): float(values.mean())}
    covariance = regressor.covariance[rows]
    if np.isfinite(covariance).all():
        position, rotation = within_bounds(*poses, covariance).mean(axis=0).tolist()
        content["within_95_percent_bounds"] = {"position": position, "rotation": rotation}
    return content


def _notes(quantised: Quantised, coreml: str) -> list[str]:
    notes = []
    if quantised.refusal:
        notes.append(f"no int8 network: {quantised.refusal}")
    elif quantised.in_float32:
        notes.append(f"int8 leaves in float32, as it is faster or more accurate so: {', '.join(quantised.in_float32)}")
    if not quantised.refusal and not quantised.is_faster:
        notes.append(
            f"int8 is slower on the machine that exported, {quantised.int8.milliseconds:.1f} ms of processor time a "
            f"query against {quantised.fp32.milliseconds:.1f} ms: measure both on the phone"
        )
    return [*notes, *([coreml] if coreml else [])]


def write_golden(
    inputs: PhoneInputs, folder: Path, networks: Mapping[str, Network], median_error: tuple[float, float]
) -> None:
    """Write golden/: some frames' images, the output of each step and of each network; median_error: m, degrees."""
    target = (folder / GOLDEN).parent
    target.mkdir()
    rows = next(rows for split in ("test", "val", "train") if (rows := inputs.spread(split, _QUERIES)))
    queries = [_query(inputs, row, number, target, networks) for number, row in enumerate(rows)]
    names = [step["step"] for step in queries[0]["steps"]]
    steps = {name: _MEAN_NORMALISED if name == "normalise" else _MEAN_LEVELS for name in names}
    loose = {n: max(least, _OF_MEDIAN * error) for (n, least), error in zip(_FP32.items(), median_error, strict=True)}
    limits = {name: _FP32 if name == "fp32" else loose for name in networks}
    write_json(folder / GOLDEN, {"tolerances": {"steps": steps, "networks": limits}, "queries": queries})


def _query(inputs: PhoneInputs, row: int, number: int, target: Path, networks: Mapping[str, Network]) -> dict[str, Any]:
    file = Path(inputs.regressor.frames["file"].iloc[row])
    image = f"{number}{file.suffix.lower()}"
    (target / image).write_bytes(without_metadata(file.read_bytes()))
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
