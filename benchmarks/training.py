"""Training speed: `python -m benchmarks.training`, with official=<folder> beside MS-Transformer's own code.

Whole training steps (crops, colours, forward, loss, backward, optimiser) at 224 px, in images a second. On one core by
processor seconds, since they tell less of what else runs; on a GPU by the clock, with the crops that the processor
makes. MS-T and the official code have the same batch, precision and dropout. Beside them stands what the step's matrix
products alone would take. Writes docs/results/training.md and .csv, of a GPU training-cuda.md and .csv.
"""

import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
import typer
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode

from benchmarks.official_mst import CONFIG, official_model
from benchmarks.results import circumstances, markdown_table, write_page
from groundwalk.store.cli import new_app
from groundwalk.training.data import Frames, ImageCache, Jitter, View, normalised
from groundwalk.training.loop import make_optimiser
from groundwalk.training.models.ms_transformer import MSTransformer
from groundwalk.training.models.regressor import PoseRegressor
from groundwalk.training.regressors import REGRESSORS
from groundwalk.training.steps import WORDS, Precision, gradient_step

app = new_app(__doc__ or "")
_CROP, _SHORT, _LONG, _IMAGES = 224, 256, 341, 16
_VIEW = View(_CROP, _CROP)
TARGET = 3.0


@dataclass(frozen=True)
class Timer:
    """Where steps are timed, and how: seconds of the processor, of a GPU those of the clock after its work is done."""

    device: torch.device
    steps: int

    def now(self) -> float:
        if self.device.type == "cpu":
            return time.process_time()
        torch.cuda.synchronize(self.device)
        return time.perf_counter()

    def median_s(self, step: Callable[[], None]) -> float:
        """Of the steps after the first, which chooses kernels and allocates."""
        step()
        seconds = []
        for _ in range(self.steps):
            start = self.now()
            step()
            seconds.append(self.now() - start)
        return float(np.median(seconds))


@dataclass(frozen=True)
class Speed:
    """Median seconds of a step."""

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
    device: Annotated[Literal["cpu", "cuda"], typer.Option(help="where to train: one core, or a GPU")] = "cpu",
    steps: Annotated[int, typer.Option(help="steps timed of each, after one that isn't")] = 3,
    out: Annotated[Path, typer.Option(help="folder for the page and its .csv")] = Path("docs/results"),
) -> None:
    """Time training steps one after the other, and write what came out."""
    torch.set_num_threads(1)
    out.mkdir(parents=True, exist_ok=True)  # Before the work, so that a folder that can't be written ends it at once.
    speeds: list[Speed] = []
    timer = Timer(torch.device(device), steps)
    with tempfile.TemporaryDirectory() as name:
        frames = _frames(Path(name))
        for model in ("MS-T", "PN"):
            for precision in WORDS:
                speeds.append(_ours(model, frames, precision, timer))
                print(speeds[-1], f"{speeds[-1].images_per_s:.3g} images/s", flush=True)
    notes = ["The official code wasn't timed: no folder with it was named (`official=`)."]
    if official is not None:
        speeds.append(_official(official, timer))
        print(speeds[-1], f"{speeds[-1].images_per_s:.3g} images/s", flush=True)
        ratio = speeds[0].images_per_s / speeds[-1].images_per_s
        notes = [f"MS-T trains {ratio:.2f} times as fast as the official code in float32; to reach: {TARGET:g}."]
        best = max(speed.images_per_s for speed in speeds if speed.name == "MS-T") / speeds[-1].images_per_s
        notes.append(f"In the faster of both precisions: {best:.2f} times.")
    notes.append(_bound(speeds, timer))
    _write(out, speeds, notes, timer.device)


def _ours(model: str, frames: Frames, precision: Precision, timer: Timer) -> Speed:
    regressor = REGRESSORS[model]
    settings: Any = regressor.settings.model_validate({"weights": "scratch"})
    batch = int(settings.batch) if model == "MS-T" else _IMAGES
    torch.manual_seed(0)
    net: PoseRegressor = regressor.make(settings, 1, True)
    net.to(timer.device, memory_format=torch.channels_last).train()  # type: ignore[call-overload]
    optimiser = make_optimiser(net, settings)
    rng = np.random.default_rng(0)
    loading: list[float] = []

    gradient = gradient_step(net, precision, timer.device)

    def step() -> None:
        start = timer.now()
        image, poses = frames.select(np.arange(batch)).training_crops(_VIEW, None, rng, timer.device)
        image = normalised(Jitter(*settings.training.jitter).apply(image, rng))
        image = image.contiguous(memory_format=torch.channels_last)
        loading.append(timer.now() - start)
        gradient((image,), poses)
        optimiser.step()

    seconds = timer.median_s(step)
    return Speed(model, batch, WORDS[precision], seconds, float(np.median(loading)) / seconds)


def _official(folder: Path, timer: Timer) -> Speed:
    torch.manual_seed(0)
    net, pose_loss = official_model(folder, 1)
    net.to(timer.device).train()
    pose_loss.to(timer.device)
    parameters = [*net.parameters(), *pose_loss.parameters()]
    settings = {name: CONFIG[name] for name in ("lr", "eps", "weight_decay")}
    optimiser = torch.optim.Adam(parameters, **settings)
    batch = int(CONFIG["batch_size"])
    image = torch.randn(batch, 3, _CROP, _CROP, device=timer.device)
    scene = torch.zeros(batch, dtype=torch.long, device=timer.device)
    truth = torch.nn.functional.normalize(torch.randn(batch, 7, device=timer.device), dim=-1)

    def step() -> None:
        optimiser.zero_grad()
        answer = net({"img": image, "scene": scene})
        loss = pose_loss(answer["pose"], truth)
        (loss + torch.nn.functional.nll_loss(answer["scene_log_distr"], scene)).backward()
        optimiser.step()

    return Speed("official MS-Transformer", batch, "float32", timer.median_s(step), 0.0)


def _bound(speeds: Sequence[Speed], timer: Timer) -> str:
    """What MS-T's products alone would allow, in a sentence."""
    work, rate = _products_gflop(), _gflop_per_s(timer)
    most = rate / work
    where = "core" if timer.device.type == "cpu" else "GPU"
    official = [speed.images_per_s for speed in speeds if speed.name.startswith("official")]
    against = f", {most / official[0]:.1f} times the official code's" if official else ""
    return (
        f"MS-T's matrix products and convolutions are {work:.1f} GFLOP an image, forward and back, and this {where} "
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


def _gflop_per_s(timer: Timer, side: int = 2048, repeats: int = 5) -> float:
    a, b = torch.randn(2, side, side, device=timer.device)
    seconds = []
    for _ in range(repeats):
        start = timer.now()
        torch.mm(a, b)
        seconds.append(timer.now() - start)
    return 2 * side**3 / min(seconds) / 1e9


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


def _write(out: Path, speeds: Sequence[Speed], notes: Sequence[str], device: torch.device) -> None:
    """Write the page and its .csv into the folder."""
    cpu = device.type == "cpu"
    name = "training" if cpu else f"training-{device.type}"
    gpu = "" if cpu else f" {torch.cuda.get_device_name(device)}, PyTorch {torch.__version__}."
    about = circumstances() + gpu
    rows = [
        [s.name, str(s.batch), s.precision, f"{s.images_per_s:.3g}", f"{100 * s.loading_fraction:.1f} %"]
        for s in speeds
    ]
    per_second = f"images_per_{'processor_' if cpu else ''}second"
    figures: list[list[object]] = [["regressor", "batch", "precision", per_second, "loading_fraction", "run"]]
    figures += [[s.name, s.batch, s.precision, s.images_per_s, s.loading_fraction, about] for s in speeds]
    of = " of one core" if cpu else ""
    head = ["regressor", "batch", "precision", f"images a second{of}", "of it crops and colours"]
    title = _HEAD.format(command=f"make bench-training{'' if cpu else ' device=cuda'}", how=_HOW[device.type])
    sections = [title, about, markdown_table([head, *rows]), "\n".join(f"- {note}" for note in notes)]
    write_page(out, name, sections, figures)


_HOW = {"cpu": "one thread, by processor seconds", "cuda": "by the clock, crops made by one thread of the processor"}
_HEAD = """# Training speed

Written by `{command}`. Whole training steps at 224 px with the published layers, batch and dropout, weights from
scratch, {how}. The official code's steps are without its loading of images."""

if __name__ == "__main__":
    app()
