"""A network in 8-bit integers, but for the parts where measuring says that it loses by it.

Static quantisation (QDQ: integer nodes between QuantizeLinear and DequantizeLinear), a scale for each channel of a
weight, ranges of activations from training frames (Jacob et al., 2018; ONNX Runtime's documentation, "Quantize ONNX
models"). Which groups of nodes stay in float32 is searched for: a group does so where the network is then more accurate
by too much, or faster, on frames that were held out of training. The large weights of what stays in float32 are stored
in 8 bits all the same, and made float32 as the network runs.
"""

import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from groundwalk.export.phone.networks import quiet
from groundwalk.geometry import Array
from groundwalk.geometry.poses import quaternion_angle
from groundwalk.runtime.bundle import onnx_session
from groundwalk.store import UserError

MAX_ERROR_RATIO = 1.05
"""of an int8 network's errors to fp32's, on held-out frames; beyond it int8 isn't shipped"""
# Held-out frames are few, and others may lose more than they do: of two networks below the limit, one above this ratio
# is taken only where it is faster by more than this factor.
_SAFE_ERROR_RATIO, _UNSAFE_TIME_FACTOR = 1.02, 1.1
_FASTER = 0.95  # a group stays in float32 for less than this fraction of the time
_TIMED_S, _MIN_RUNS, _MAX_RUNS = 2.0, 5, 60
_WITH_WEIGHTS = "Conv", "Gemm", "MatMul"
_GROUPS = {"Gemm": "products", "MatMul": "products", "Add": "sums", "Mul": "gates", "Sigmoid": "gates"}
_LARGE = 10_000  # weights of a node; fewer take no room
_BETWEEN = ("Add", "Relu", "Clip", "MaxPool", "GlobalAveragePool", "Flatten", "Reshape", "Mul", "Sigmoid")

Tensors = Sequence[NDArray[np.float32]]


@dataclass(frozen=True)
class HeldOut:
    """Network inputs (1, 3, H, W) of N frames with their true positions (N, 3), m, and quaternions xyzw (N, 4)."""

    tensors: Tensors
    position: Array
    quaternion: Array


@dataclass(frozen=True)
class Measured:
    """Processor milliseconds a query on one thread, and mean errors over the held-out frames."""

    milliseconds: float
    position_m: float
    rotation_deg: float

    def ratio(self, other: "Measured") -> float:
        """The larger ratio of these errors to another's."""
        return max(self.position_m / max(other.position_m, 1e-9), self.rotation_deg / max(other.rotation_deg, 1e-9))


@dataclass(frozen=True)
class Quantised:
    """What became of a network: the groups of nodes in float32, both networks as they were measured, and, where int8
    is too inaccurate to be shipped, the reason."""

    in_float32: tuple[str, ...]
    fp32: Measured
    int8: Measured
    refusal: str

    @property
    def is_faster(self) -> bool:
        """int8 took less processor time than fp32 on this machine."""
        return self.int8.milliseconds < self.fp32.milliseconds


def write_int8(fp32: Path, out: Path, calibration: Tensors, held_out: HeldOut) -> Quantised:
    """Write the int8 network of `fp32`, unless it loses too much by it; see the module."""
    try:
        from onnxruntime.quantization import QuantFormat, QuantType, quant_pre_process, quantize_static
    except ImportError as error:
        do = "pip install 'groundwalk[phone]', or onnx and onnxruntime"
        raise UserError("exporting needs more packages", found=error, do=do) from None
    with tempfile.TemporaryDirectory(prefix="groundwalk-") as name, quiet():
        prepared, files = Path(name) / "prepared.onnx", dict[tuple[str, ...], Path]()
        # Batch norms are folded into convolutions, as quantisation wants it.
        quant_pre_process(fp32, prepared, skip_symbolic_shape=True)
        groups, never = _groups(prepared)

        @cache
        def trial(in_float32: tuple[str, ...]) -> Measured:
            """The network with these groups in float32, made and measured."""
            file = files[in_float32] = Path(name) / f"int8-{len(files)}.onnx"
            excluded = [*never, *(node for group in in_float32 for node in groups[group])]
            inputs = iter([{"image": tensor} for tensor in calibration])
            quantize_static(
                prepared,
                file,
                SimpleNamespace(get_next=lambda: next(inputs, None)),
                quant_format=QuantFormat.QDQ,
                op_types_to_quantize=[*_WITH_WEIGHTS, *_BETWEEN],
                per_channel=True,
                activation_type=QuantType.QUInt8,
                weight_type=QuantType.QInt8,
                nodes_to_exclude=excluded,
                calibration_cache_path=Path(name) / "ranges.json",
            )
            _store_in_int8(file, excluded)
            return measure(file, held_out)

        measured = measure(prepared, held_out)
        best, int8 = _search(list(groups), trial, measured)
        ratio, refusal = int8.ratio(measured), ""
        if ratio <= MAX_ERROR_RATIO:
            out.write_bytes(files[best].read_bytes())
        else:
            refusal = f"its errors on held-out frames are {ratio:.2f} times those of fp32, over {MAX_ERROR_RATIO}"
    return Quantised(best, measured, int8, refusal)


def _search(
    groups: Sequence[str], trial: Callable[[tuple[str, ...]], Measured], fp32: Measured
) -> tuple[tuple[str, ...], Measured]:
    """The groups to leave in float32, one more at a time as long as that pays, and the network that they make."""
    best: tuple[str, ...] = ()
    for group in groups:
        more = tuple(sorted({*best, group}))
        if len(more) < len(groups) and _is_better(trial(more), trial(best), fp32):
            best = more
    return best, trial(best)


def _is_better(one: Measured, other: Measured, fp32: Measured) -> bool:
    fits, other_fits = (m.ratio(fp32) <= MAX_ERROR_RATIO for m in (one, other))
    if fits and other_fits:
        time, other_time = (
            m.milliseconds * (_UNSAFE_TIME_FACTOR if m.ratio(fp32) > _SAFE_ERROR_RATIO else 1) for m in (one, other)
        )
        return time < _FASTER * other_time
    return fits or (not other_fits and one.ratio(fp32) < other.ratio(fp32))


def measure(file: Path, held_out: HeldOut) -> Measured:
    """Time and mean errors of a network on held-out frames. Processor time, since it tells less of what else runs."""
    session = onnx_session(file, 1)
    answers = [session.run(["position", "quaternion"], {"image": tensor}) for tensor in held_out.tensors]
    distance = np.linalg.norm(np.concatenate([a[0] for a in answers]) - held_out.position, axis=1)
    angle = np.degrees(quaternion_angle(np.concatenate([a[1] for a in answers]).astype(float), held_out.quaternion))
    times: list[float] = []
    while len(times) < _MIN_RUNS or (len(times) < _MAX_RUNS and sum(times) < _TIMED_S):
        start = time.process_time()
        session.run(None, {"image": held_out.tensors[0]})
        times.append(time.process_time() - start)
    return Measured(1e3 * float(np.median(times)), float(distance.mean()), float(angle.mean()))


def _groups(file: Path) -> tuple[dict[str, list[str]], list[str]]:
    """Nodes that are decided on together, by what they are; and those that always stay in float32: the last weights and
    what follows, as a position in 255 steps is none, and products without weights, as in attention."""
    import onnx

    graph = onnx.load(file).graph
    weights = {tensor.name: list(tensor.dims) for tensor in graph.initializer}
    makers = {name: node for node in graph.node for name in node.output}
    weighted = {node.name for node in graph.node if any(name in weights for name in node.input[1:2])}
    # From the outputs back to the first nodes with weights, these included.
    names, last = [output.name for output in graph.output], set()
    while names:
        node = makers.get(names.pop())
        if node is not None and node.name not in last:
            last.add(node.name)
            names += [] if node.op_type in _WITH_WEIGHTS and node.name in weighted else node.input
    groups: dict[str, list[str]] = {}
    never = []
    for node in graph.node:
        if node.name in last or (node.op_type in _WITH_WEIGHTS and node.name not in weighted):
            never.append(node.name)
        elif kind := _kind(node, weights):
            groups.setdefault(kind, []).append(node.name)
    return groups, never


def _kind(node: Any, weights: dict[str, list[int]]) -> str:
    if node.op_type != "Conv":
        return _GROUPS.get(node.op_type, "")
    size, (_, inputs, *kernel) = next((a.i for a in node.attribute if a.name == "group"), 1), weights[node.input[1]]
    if size > 1 and inputs == 1:
        return "depthwise convolutions"
    return "1x1 convolutions" if set(kernel) == {1} else "convolutions"


def _store_in_int8(file: Path, nodes: Sequence[str]) -> None:
    """Store the large weights of these nodes as integers, with a scale for each of their outputs."""
    import onnx
    from onnx import helper, numpy_helper

    model = onnx.load(file)
    graph = model.graph
    tensors = {tensor.name: tensor for tensor in graph.initializer}
    for node in [node for node in graph.node if node.op_type in _WITH_WEIGHTS and node.name in set(nodes)]:
        name = node.input[1]
        if name not in tensors or np.prod(tensors[name].dims) < _LARGE:
            continue
        weights = numpy_helper.to_array(tensors[name])
        outputs_first = node.op_type == "Conv" or any(a.name == "transB" and a.i for a in node.attribute)
        axis = 0 if outputs_first else weights.ndim - 1
        others = tuple(i for i in range(weights.ndim) if i != axis)
        scale = np.maximum(np.abs(weights).max(axis=others, keepdims=True), np.float32(1e-12)) / np.float32(127)
        parts = {
            "integers": np.round(weights / scale).astype(np.int8),
            "scale": scale.ravel().astype(np.float32),
            "zero": np.zeros(scale.size, np.int8),
        }
        stored = [numpy_helper.from_array(value, f"{name} {part}") for part, value in parts.items()]
        graph.initializer.extend(stored)
        graph.initializer.remove(tensors.pop(name))
        made = helper.make_node("DequantizeLinear", [t.name for t in stored], [f"{name} float32"], axis=axis)
        graph.node.insert(list(graph.node).index(node), made)
        node.input[1] = f"{name} float32"
    onnx.save(model, file)
