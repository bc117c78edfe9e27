"""The streaming interface of every localiser: one frame in, one estimate out, causal, in bounded memory; and its state,
as JSON has it: data alone, so that a state from elsewhere runs no code."""

import base64
import io
import json
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from groundwalk.geometry import GeometryError
from groundwalk.geometry.poses import Array, rigidity_error
from groundwalk.store import Settings, UserError

_RIGID = 1e-4
_ARRAY = "npy"


class Status(StrEnum):
    """What stands behind an estimate."""

    PREDICTED = "predicted"  # the regressor's pose, unchecked
    RELIABLE = "reliable"  # the regressor's pose, found consistent with odometry
    OPTIMISED = "optimised"  # odometry carried into the map by the current alignment
    ALIGNING = "aligning"  # odometry carried by an alignment that is no longer trusted
    FUSED = "fused"  # both, weighed by how far each can be trusted
    LOST = "lost"  # odometry carried on, while it isn't clear whether it still has the frame that was aligned
    NONE = "none"  # no pose


@dataclass(frozen=True, slots=True)
class Estimate:
    """What a localiser says about one frame.

    map_T_cam: pose (4, 4), or None where the status is `none`.
    covariance: (6, 6) of the pose's error in the map frame, rotation (rad) then translation (m), or None where the
        method doesn't know.
    map_T_vio: the alignment (4, 4) in force after this frame, or None before there is one.
    confirms: earlier frames (their t_ns and map_T_cam) that this frame shows to have been reliable. An app never saw
        these poses in time; the paper counts them.
    reasons: short codes of what led to the status, most telling first.
    signals: the numbers behind the decision, by name and unit (`rpe_m`, `roe_deg`, `similarity`, ...).
    """

    map_T_cam: Array | None
    status: Status
    covariance: Array | None = None
    map_T_vio: Array | None = None
    confirms: tuple[tuple[int, Array], ...] = ()
    reasons: tuple[str, ...] = ()
    signals: Mapping[str, float] = field(default_factory=dict)

    def because(self, reason: str) -> "Estimate":
        """The same with one more reason, the most telling one."""
        return replace(self, reasons=(reason, *self.reasons))


class MethodOptions(Settings):
    """Base of every method's options."""

    @property
    def json_text(self) -> str:
        """The options as tables hold them: JSON with sorted keys."""
        return json.dumps(self.model_dump(mode="json"), sort_keys=True)

    @property
    def gates(self) -> dict[str, float]:
        """The thresholds that signals are held against, by signal."""
        return {}


class Stepping(Protocol):
    """All that evaluation asks of a causal method; a session has a fresh one."""

    def step(
        self, t_ns: int, vio_T_cam: Array | None, map_T_cam_predicted: Array | None, gravity: Array | None = None
    ) -> Estimate: ...


class Localiser(ABC):
    """Turns odometry and the regressor's predictions into map poses, one frame at a time.

    One localiser follows one device. `step` is fed every odometry frame in order of time; frames without a prediction
    (odometry runs at 60 Hz, a regressor at 1 Hz) pass None. Without options it has the defaults of its own.
    """

    options_type: ClassVar[type[MethodOptions]]
    options: Any
    _not_saved: ClassVar[tuple[str, ...]] = ("options",)
    """Attributes that are no state: they follow from the options, or serve one step only."""

    def __init__(self, options: MethodOptions | None = None) -> None:
        self.options = options or self.options_type()
        self._t_ns: int | None = None
        self._predicted_covariance: Array | None = None  # what the frame's prediction brings, for methods that use it
        self._forget()

    def step(
        self,
        t_ns: int,
        vio_T_cam: Array | None,
        map_T_cam_predicted: Array | None,
        gravity: Array | None = None,
        predicted_covariance: Array | None = None,
    ) -> Estimate:
        """The estimate for the frame at `t_ns`.

        vio_T_cam: odometry pose (4, 4) in the session's frame, or None where tracking is lost.
        map_T_cam_predicted: predicted pose (4, 4), or None where there is none. One that isn't finite or isn't rigid is
            taken as None, and the estimate's reasons hold `prediction_invalid`. Where it comes late, as from a server,
            odometry carries it to this frame first: map_T_cam_then @ inverse(vio_T_cam_then) @ vio_T_cam.
        gravity: unit vector (3,) pointing down, camera axes, or None; none of these methods looks at it.
        predicted_covariance: (6, 6) of the prediction's error in the map frame, rotation (rad) then translation (m), or
            None. One that isn't positive definite is taken as None, and the estimate's reasons hold
            `covariance_invalid`.

        Raises GeometryError where time doesn't rise or the odometry pose isn't a finite rigid transform.
        """
        if self._t_ns is not None and t_ns <= self._t_ns:
            raise GeometryError(f"frame at {t_ns} ns comes after one at {self._t_ns} ns: time must rise")
        if vio_T_cam is not None and not is_rigid(vio_T_cam):
            raise GeometryError(f"odometry pose at {t_ns} ns isn't a finite rigid transform")
        invalid = map_T_cam_predicted is not None and not is_rigid(map_T_cam_predicted)
        unsound = predicted_covariance is not None and not is_covariance(predicted_covariance)
        self._predicted_covariance = None if unsound else predicted_covariance
        estimate = self._advance(t_ns, vio_T_cam, None if invalid else map_T_cam_predicted)
        self._t_ns, self._predicted_covariance = t_ns, None
        if unsound:
            estimate = estimate.because("covariance_invalid")
        return estimate.because("prediction_invalid") if invalid else estimate

    def reset(self) -> None:
        """Forget everything: a new odometry session begins, and its frame has nothing to do with the last one's."""
        self._t_ns = None
        self._forget()

    def save(self) -> dict[str, Any]:
        """The whole state as JSON has it; `restore` on a localiser with the same options goes on from it."""
        return _plain({name: value for name, value in vars(self).items() if name not in self._not_saved})

    def restore(self, state: dict[str, Any]) -> None:
        """Take over a state that `save` returned. UserError where it is of another method or version."""
        self.reset()
        _restore_into(self, state, self._not_saved)

    @abstractmethod
    def _advance(self, t_ns: int, vio_T_cam: Array | None, map_T_cam_predicted: Array | None) -> Estimate:
        """`step` on inputs that are checked."""

    def _forget(self) -> None:
        """Drop what was learnt about the odometry's frame. Methods with a state override this."""
        return None


def is_covariance(matrix: Array) -> bool:
    """Whether a matrix (6, 6) is finite, symmetric and positive definite."""
    if matrix.shape != (6, 6) or not np.isfinite(matrix).all() or not np.allclose(matrix, matrix.T, rtol=1e-6):
        return False
    sd = np.sqrt(np.abs(matrix.diagonal())) + 1e-300
    return bool(matrix.diagonal().min() > 0 and np.linalg.eigvalsh(matrix / np.outer(sd, sd))[0] > 1e-9)


def is_rigid(pose: Array) -> NDArray[np.bool_]:
    """Whether poses (..., 4, 4) are finite rigid transforms, as near as single precision stores them."""
    return np.asarray(rigidity_error(pose) < _RIGID)


def _plain(value: Any) -> Any:
    """A value as JSON has it: objects and dictionaries as their attributes, arrays as NumPy's files, in base64."""
    if isinstance(value, np.ndarray):
        file = io.BytesIO()
        np.save(file, value, allow_pickle=False)
        return {_ARRAY: base64.b64encode(file.getvalue()).decode()}
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, tuple | list | deque):
        return [_plain(item) for item in value]
    if isinstance(value, dict) or hasattr(value, "__dict__"):
        content = value if isinstance(value, dict) else vars(value)
        return {name: _plain(item) for name, item in content.items()}
    return value


def _restore_into(owner: object, state: Any, kept: tuple[str, ...] = ()) -> None:
    """Give an object the attributes that `_plain` got, but those that are `kept`; the ones that it has say of what kind
    each is. UserError where it has others."""
    own = {name: value for name, value in getattr(owner, "__dict__", {}).items() if name not in kept}
    if not isinstance(state, dict) or set(state) != set(own):
        raise UserError(
            "the state is of another method, or of another version of groundwalk",
            where=type(owner).__name__,
            expected=", ".join(own),
            found=", ".join(map(str, state)) if isinstance(state, dict) else type(state).__name__,
            do="begin anew, without it",
        )
    for name, value in state.items():
        setattr(owner, name, _restored(value, own[name]))


def _restored(value: Any, like: Any) -> Any:
    """What `_plain` got, with `like` in its place in a fresh object; a list in nothing's place was a tuple."""
    if isinstance(value, list):
        items = [_restored(item, None) for item in value]
        return (
            deque(items, like.maxlen) if isinstance(like, deque) else items if isinstance(like, list) else tuple(items)
        )
    if not isinstance(value, dict):
        return value
    if set(value) == {_ARRAY}:
        return np.load(io.BytesIO(base64.b64decode(value[_ARRAY])), allow_pickle=False)
    _restore_into(like, value)
    return like
