"""Regressors on a phone: `python -m benchmarks.phone`.

Exports bundles of a finished train stage and asks them, without PyTorch, about the test frames: bytes, milliseconds and
errors of fp32 and int8. Times are of the published image size, 224 px, too, for which the same networks are exported
without regard to accuracy. Writes docs/results/phone.md and .csv.
"""

import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import typer
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from benchmarks.results import circumstances, instruction_sets, markdown_table, side_by_side, write_page
from groundwalk.export.phone.bundle import write_bundle
from groundwalk.export.phone.inputs import PhoneInputs
from groundwalk.export.phone.networks import write_onnx
from groundwalk.export.phone.quantisation import MAX_ERROR_RATIO, HeldOut, write_int8
from groundwalk.export.regressor import TrainedRegressor, load_regressor
from groundwalk.geometry import Array
from groundwalk.runtime import open_bundle
from groundwalk.runtime.bundle import Prediction, onnx_session
from groundwalk.scoring.errors import position_error, rotation_error_deg
from groundwalk.store import DataRoot, UserError
from groundwalk.store.cli import new_app
from groundwalk.store.manifests import MANIFEST, load_manifest
from groundwalk.store.tables import table_of

app = new_app(__doc__ or "")

PUBLISHED_PX = 224
_TIMED, _WARM_UP, _TENSORS, _RESAMPLED = 60, 5, 16, 2000
_KINDS: dict[str, Any] = {"median": np.median, "mean": np.mean}
# MiB, as the paper counts, and median milliseconds on two cores at the published size.
TARGETS = {
    ("PN", "int8", "size"): 22.0,
    ("PN", "int8", "224 px, 2 threads"): 12.0,
    ("PN-Lite", "int8", "size"): 6.0,
    ("PN-Lite", "int8", "224 px, 2 threads"): 8.0,
}


@dataclass(frozen=True)
class Figure:
    """One number of a model's network."""

    model: str
    network: str
    name: str
    value: float
    unit: str
    most: float | None = None


@app.command()
def main(
    data: Annotated[
        str,
        typer.Option(
            help="data roots with a finished train stage, separated by commas; of a regressor that several have, "
            "sizes and times are of the first, errors of all together"
        ),
    ] = "data",
    scene: Annotated[str, typer.Option(help="scene of the run")] = "Church",
    profile: Annotated[str, typer.Option(help="profile of the run")] = "demo",
    out: Annotated[Path, typer.Option(help="folder for phone.md and .csv")] = Path("docs/results"),
) -> None:
    """Export each regressor of the run, ask it, and write what came out."""
    figures: list[Figure] = []
    notes: list[str] = []
    kind = ""
    regressors: dict[str, list[TrainedRegressor]] = {}
    for root in map(DataRoot, map(Path, data.split(","))):
        folder = root.run(profile, scene, "train")
        if not (folder / MANIFEST).is_file():
            raise UserError("there is no finished train stage", where=folder, do=f"run the scene {scene} first")
        manifest = load_manifest(folder)
        kind = "simulated" if manifest["simulated"] else "real"
        cards = table_of(folder.parent, "train", "models")
        for model in cards.loc[cards["file"] != "", "model"]:
            regressor = load_regressor(root, profile, scene, str(model))
            regressors.setdefault(str(model), []).append(regressor)
            notes.append(f"{model}: trained at revision {manifest['git_revision']}, seed {regressor.card['seed']}")
    for trained in regressors.values():
        for figure in (*_of_bundles(trained, notes), *_at_published_size(trained[0], notes)):
            print(f"{figure.model} {figure.network}: {figure.name} {figure.value:.4g} {figure.unit}", flush=True)
            figures.append(figure)
    _write(out, figures, notes, f"Scene {scene} ({kind}), profile {profile}.")


def _of_bundles(regressors: Sequence[TrainedRegressor], notes: list[str]) -> Iterator[Figure]:
    """Bytes and times of the first bundle's networks, and errors of all bundles' on the test frames, as a phone asks
    about them. A network that one of the bundles is without has no errors."""
    model, crop = regressors[0].model, regressors[0].trained.crop
    errors: dict[str, list[dict[str, Array]]] = {}
    for regressor in regressors:
        for network, size, answers, of_network in _asked(regressor, notes):
            errors.setdefault(network, []).append(of_network)
            if regressor is not regressors[0]:
                continue
            yield Figure(model, network, "size", size, "MiB", TARGETS.get((model, network, "size")))
            for part in ("preprocessing", "network"):
                times = [1e3 * answer.seconds[part] for answer in answers[_WARM_UP:]]
                yield from _median_and_p95(model, network, f"{crop} px, 2 threads, {part}", times)
    units = {"position": "m", "rotation": "deg"}
    of_all = {
        network: {part: np.concatenate([one[part] for one in each]) for part in units}
        for network, each in errors.items()
        if len(each) == len(regressors)
    }
    for network, of_network in of_all.items():
        for part, unit in units.items():
            for kind, of in _KINDS.items():
                yield Figure(model, network, f"{kind} {part} error", float(of(of_network[part])), unit)
    if "int8" in of_all:
        yield from _ratios(model, of_all["int8"], of_all["fp32"])


def _asked(
    regressor: TrainedRegressor, notes: list[str]
) -> Iterator[tuple[str, float, list[Prediction], dict[str, Array]]]:
    """Of each network of the regressor's bundle: its name, MiB, answers to the test frames, and their errors."""
    inputs = PhoneInputs(regressor)
    rows = inputs.spread("test", len(regressor.frames))
    with tempfile.TemporaryDirectory() as name:
        title = f"{regressor.model}, seed {regressor.card['seed']}"
        notes += [f"{title}: {note}" for note in write_bundle(regressor, Path(name))[1:]]
        for network, about in open_bundle(name).manifest["networks"].items():
            bundle = open_bundle(name, network=network, threads=2)
            answers = [bundle.ask(inputs.query(row)) for row in rows]
            poses = np.array([answer.map_T_cam for answer in answers]), regressor.map_T_cam[rows]
            errors = {"position": position_error(*poses), "rotation": rotation_error_deg(*poses)}
            yield network, about["bytes"] / 2**20, answers, errors


def _ratios(model: str, int8: dict[str, Array], fp32: dict[str, Array]) -> Iterator[Figure]:
    """int8's errors over fp32's, and between which bounds 95 % of resampled test frames have that."""
    for part in int8:
        drawn = np.random.default_rng(0).integers(0, len(int8[part]), (_RESAMPLED, len(int8[part])))
        for kind, of in _KINDS.items():
            label = f"{kind} {part} error, int8 / fp32"
            yield Figure(model, "int8", label, float(of(int8[part]) / of(fp32[part])), "", MAX_ERROR_RATIO)
            resampled = of(int8[part][drawn], axis=1) / of(fp32[part][drawn], axis=1)
            for end, percent in (("least", 2.5), ("most", 97.5)):
                yield Figure(model, "int8", f"{label}, {end}", float(np.percentile(resampled, percent)), "")


def _at_published_size(regressor: TrainedRegressor, notes: list[str]) -> Iterator[Figure]:
    """Times of the same networks for images of the published size, whatever they were trained on.

    Images of another size than in training have no errors to go by: a truth far away leaves the choice of what is int8
    to the times.
    """
    model, trained = regressor.model, regressor.trained
    size = PUBLISHED_PX, round(PUBLISHED_PX * trained.width / trained.crop)
    tensors = [
        _enlarged(tensor, size) for tensor in map(PhoneInputs(regressor).tensor, regressor.rows("val")[:_TENSORS])
    ]
    with tempfile.TemporaryDirectory() as name:
        files = {network: Path(name) / f"{network}.onnx" for network in ("fp32", "int8")}
        write_onnx(trained, *size, files["fp32"])
        session = onnx_session(files["fp32"], 1)
        answers = [session.run(["position", "quaternion"], {"image": tensor}) for tensor in tensors]
        aside = Rotation.from_euler("y", 90, degrees=True)
        quaternion = (aside * Rotation.from_quat(np.concatenate([answer[1] for answer in answers]))).as_quat()
        position = np.concatenate([answer[0] for answer in answers]) + np.array([1000.0, 0, 0])
        quantised = write_int8(files["fp32"], files["int8"], tensors, HeldOut(tensors, position, quaternion))
        if quantised.refusal:
            notes.append(f"{model} at {PUBLISHED_PX} px: no int8 network: {quantised.refusal}")
        elif quantised.in_float32:
            notes.append(
                f"{model} at {size[1]} x {size[0]} px: int8 leaves in float32: {', '.join(quantised.in_float32)}"
            )
        for network in (network for network, file in files.items() if file.is_file()):
            for threads in (1, 2):
                yield from _times(model, network, files[network], threads, tensors[0])


def _enlarged(tensor: NDArray[np.float32], size: tuple[int, int]) -> NDArray[np.float32]:
    large = cv2.resize(tensor[0].transpose(1, 2, 0), size[::-1], interpolation=cv2.INTER_LINEAR)
    return np.ascontiguousarray(large.transpose(2, 0, 1)[None])


def _times(model: str, network: str, file: Path, threads: int, tensor: NDArray[np.float32]) -> Iterator[Figure]:
    session = onnx_session(file, threads)
    clock, processor = [], []
    for _ in range(_WARM_UP + _TIMED):
        start, cpu = time.perf_counter(), time.process_time()
        session.run(None, {"image": tensor})
        clock.append(1e3 * (time.perf_counter() - start))
        processor.append(1e3 * (time.process_time() - cpu))
    label = f"{PUBLISHED_PX} px, {threads} thread{'s' if threads > 1 else ''}"
    for what, ms in ((label, clock), (f"{label}, processor", processor)):
        yield from _median_and_p95(model, network, what, ms[_WARM_UP:])


def _median_and_p95(model: str, network: str, label: str, ms: list[float]) -> Iterator[Figure]:
    yield Figure(model, network, f"{label}, median", float(np.median(ms)), "ms", TARGETS.get((model, network, label)))
    yield Figure(model, network, f"{label}, p95", float(np.percentile(ms, 95)), "ms")


def _write(out: Path, figures: Sequence[Figure], notes: Sequence[str], inputs: str) -> None:
    """Write phone.md and phone.csv into the folder."""
    about = f"{circumstances()} Instruction sets: {instruction_sets()}. {inputs}"
    rows: list[list[object]] = [["model", "network", "figure", "value", "unit", "most", "met", "circumstances"]]
    for f in figures:
        most = "" if f.most is None else f.most
        rows.append([f.model, f.network, f.name, f"{f.value:.6g}", f.unit, most, _met(f), about])
    targets = [["model", "network", "figure", "value", "at most", ""]]
    targets += [
        [f.model, f.network, f.name, f"{f.value:.3g} {f.unit}", f"{f.most:g} {f.unit}", _met(f)]
        for f in figures
        if f.most is not None
    ]
    sections = [_HEAD, about, markdown_table(targets), "\n".join(f"- {note}" for note in notes)]
    for model in dict.fromkeys(f.model for f in figures):
        cells = {(f.name, f.network): f"{f.value:.3g} {f.unit}" for f in figures if f.model == model}
        sections += [f"## {model}", markdown_table(side_by_side(cells))]
    write_page(out, "phone", sections, rows)


def _met(figure: Figure) -> str:
    return "" if figure.most is None else "met" if figure.value <= figure.most else "missed"


_HEAD = """# Regressors on a phone

Written by `make bench-phone`. Networks of runs' bundles, asked about their test frames without PyTorch; and the same
networks at 224 px, the published size, whatever size the profile trains at: these say what they cost and nothing of
accuracy. Times are of the network alone unless they say preprocessing, on the clock unless they say processor: where
other work ran beside, the processor's are the ones to trust. Integers are multiplied fast where the processor has
sums of four 8-bit products in one instruction (avx_vnni, avx512_vnni, asimddp, which phones have); with avx2 alone it
takes three. Ratios of errors have beside them, as least and most, what 95 % of 2000 draws of as many test frames,
with repeats, have: where 1.05 lies between, so few frames don't say. Of a regressor that was trained several times,
sizes and times are of the first training, errors of all together. Sizes are in MiB, as the paper counts."""

if __name__ == "__main__":
    app()
