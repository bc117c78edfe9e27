"""Training speed: `python -m benchmarks.training`, with official=<folder> beside MS-Transformer's own code.

Whole training steps (crops, colours, forward, loss, backward, optimiser) at 224 px, in images a second of one core: by
processor seconds, since they tell less of what else runs. MS-T and the official code have the same batch, precision and
dropout. Beside them stands what the step's matrix products alone would take. Writes docs/results/training.md and .csv.
"""

import csv
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import typer
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode

from benchmarks.official_mst import CONFIG, official_model
from benchmarks.results import circumstances, markdown_table
from groundwalk.artefacts.cli import new_app
from groundwalk.training.data import Frames, ImageCache, Jitter, View, normalised
from groundwalk.training.loop import make_optimiser
from groundwalk.training.models.ms_transformer import MSTransformer
from groundwalk.training.models.regressor import PoseRegressor
from groundwalk.training.precision import WORDS, Precision, autocast
from groundwalk.training.regressors import REGRESSORS

app = new_app(__doc__ or "")
_CROP, _SHORT, _LONG, _IMAGES = 224, 256, 341, 16
_CPU, _VIEW = torch.device("cpu"), View(_CROP, _CROP)
TARGET = 3.0


@dataclass(frozen=True)
class Speed:
    """Median processor seconds of a step."""

    name: str
    batch: int
    precision: str
    seconds: float
    loading_fraction: float

    @property
    def images_per_s(self) -> float:
        return self.batch / self.seconds


@app.command()
def main(
    official: Annotated[
        Path | None, typer.Option(help="folder with MS-Transformer's official code; skipped without")
    ] = None,
    steps: Annotated[int, typer.Option(help="steps timed of each, after one that isn't")] = 3,
    out: Annotated[Path, typer.Option(help="folder for training.md and .csv")] = Path("docs/results"),
) -> None:
    """Time training steps one after the other, and write what came out."""
    torch.set_num_threads(1)
    out.mkdir(parents=True, exist_ok=True)  # Before the work, so that a folder that can't be written ends it at once.
    speeds: list[Speed] = []
    with tempfile.TemporaryDirectory() as name:
        frames = _frames(Path(name))
        for model in ("MS-T", "PN"):
            for precision in WORDS:
                speeds.append(_ours(model, frames, precision, steps))
                print(speeds[-1], f"{speeds[-1].images_per_s:.3g} images/s", flush=True)
    notes = ["The official code wasn't timed: no folder with it was named (`official=`)."]
    if official is not None:
        speeds.append(_official(official, steps))
        print(speeds[-1], f"{speeds[-1].images_per_s:.3g} images/s", flush=True)
        ratio = speeds[0].images_per_s / speeds[-1].images_per_s
        notes = [f"MS-T trains {ratio:.2f} times as fast as the official code in float32; to reach: {TARGET:g}."]
        best = max(speed.images_per_s for speed in speeds if speed.name == "MS-T") / speeds[-1].images_per_s
        notes.append(f"In the faster of both precisions: {best:.2f} times.")
    notes.append(_bound(speeds))
    _write(out, speeds, notes)


def _ours(model: str, frames: Frames, precision: Precision, steps: int) -> Speed:
    regressor = REGRESSORS[model]
    settings: Any = regressor.settings.model_validate({"weights": "scratch"})
    batch = int(settings.batch) if model == "MS-T" else _IMAGES
    torch.manual_seed(0)
    net: PoseRegressor = regressor.make(settings, 1, True)
    net.to(memory_format=torch.channels_last).train()  # type: ignore[call-overload]
    optimiser = make_optimiser(net, settings)
    rng = np.random.default_rng(0)
    loading: list[float] = []

    def step() -> None:
        start = time.process_time()
        image, poses = frames.select(np.arange(batch)).training_crops(_VIEW, None, rng, _CPU)
        image = normalised(Jitter(*settings.jitter).apply(image, rng)).contiguous(memory_format=torch.channels_last)
        loading.append(time.process_time() - start)
        with autocast(precision, _CPU):
            loss = net.loss(image, poses)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()

    seconds = _median_s(step, steps)
    return Speed(model, batch, WORDS[precision], seconds, float(np.median(loading)) / seconds)


def _official(folder: Path, steps: int) -> Speed:
    torch.manual_seed(0)
    net, pose_loss = official_model(folder, 1)
    net.train()
    parameters = [*net.parameters(), *pose_loss.parameters()]
    settings = {name: CONFIG[name] for name in ("lr", "eps", "weight_decay")}
    optimiser = torch.optim.Adam(parameters, **settings)
    batch = int(CONFIG["batch_size"])
    image, scene = torch.randn(batch, 3, _CROP, _CROP), torch.zeros(batch, dtype=torch.long)
    truth = torch.nn.functional.normalize(torch.randn(batch, 7), dim=-1)

    def step() -> None:
        optimiser.zero_grad()
        answer = net({"img": image, "scene": scene})
        loss = pose_loss(answer["pose"], truth)
        (loss + torch.nn.functional.nll_loss(answer["scene_log_distr"], scene)).backward()
        optimiser.step()

    return Speed("official MS-Transformer", batch, "float32", _median_s(step, steps), 0.0)


def _bound(speeds: Sequence[Speed]) -> str:
    """What MS-T's products alone would allow, in a sentence."""
    work, rate = _products_gflop(), _gflop_per_s()
    most = rate / work
    official = [speed.images_per_s for speed in speeds if speed.name.startswith("official")]
    against = f", {most / official[0]:.1f} times the official code's" if official else ""
    return (
        f"MS-T's matrix products and convolutions are {work:.1f} GFLOP an image, forward and back, and this core "
        f"multiplies large float32 matrices at {rate:.0f} GFLOP/s: no float32 step could train more than {most:.2f} "
        f"images a second{against}. Ours reaches {speeds[0].images_per_s / most:.0%} of it. The rest are attention's "
        "exponentials, dropout's masks, norms, activations, and products that the gradient makes again."
    )


def _products_gflop() -> float:
    """Of an image: three times the forward pass, as each product has two in the gradient."""
    net = MSTransformer(dropout=0).train().requires_grad_(False)
    with sdpa_kernel(SDPBackend.MATH), FlopCounterMode(display=False) as counter:
        net._decode(torch.zeros(2, 3, _CROP, _CROP))
    return 3 * counter.get_total_flops() / 2 / 1e9


def _gflop_per_s(side: int = 2048, repeats: int = 5) -> float:
    a, b = torch.randn(2, side, side)
    seconds = []
    for _ in range(repeats):
        start = time.process_time()
        torch.mm(a, b)
        seconds.append(time.process_time() - start)
    return 2 * side**3 / min(seconds) / 1e9


def _median_s(step: Callable[[], None], steps: int) -> float:
    step()
    seconds = []
    for _ in range(steps):
        start = time.process_time()
        step()
        seconds.append(time.process_time() - start)
    return float(np.median(seconds))


def _frames(folder: Path) -> Frames:
    """Frames of noise: what is in an image costs nothing."""
    rng = np.random.default_rng(0)

    def images() -> Iterator[np.ndarray]:
        for _ in range(_IMAGES):
            yield rng.integers(0, 255, (_SHORT, _LONG, 3), dtype=np.uint8)

    cache = ImageCache.build(folder, images())
    K = np.tile(np.array([[300.0, 0, _LONG / 2], [0, 300.0, _SHORT / 2], [0, 0, 1]]), (_IMAGES, 1, 1))
    quaternion, same = np.tile([0, 0, 0, 1.0], (_IMAGES, 1)), np.zeros(_IMAGES, np.int64)
    position, down = rng.normal(size=(_IMAGES, 3)), np.tile([0, 1.0, 0], (_IMAGES, 1))
    return Frames(cache, np.arange(_IMAGES), K, position, quaternion, same, same, down)


def _write(out: Path, speeds: Sequence[Speed], notes: Sequence[str]) -> None:
    """Write training.md and training.csv into the folder."""
    about = circumstances()
    rows = [
        [s.name, str(s.batch), s.precision, f"{s.images_per_s:.3g}", f"{100 * s.loading_fraction:.1f} %"]
        for s in speeds
    ]
    with (out / "training.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["regressor", "batch", "precision", "images_per_processor_second", "loading_fraction", "run"])
        writer.writerows([s.name, s.batch, s.precision, s.images_per_s, s.loading_fraction, about] for s in speeds)
    head = ["regressor", "batch", "precision", "images a second of one core", "of it crops and colours"]
    sections = [_HEAD, about, markdown_table([head, *rows]), "\n".join(f"- {note}" for note in notes)]
    (out / "training.md").write_text("\n\n".join(sections) + "\n", encoding="utf-8")


_HEAD = """# Training speed

Written by `make bench-training`. Whole training steps at 224 px with the published layers, batch and dropout, weights
from scratch, one thread, by processor seconds. The official code's steps are without its loading of images."""

if __name__ == "__main__":
    app()
