"""Did SfM register enough frames, how certain are scale and vertical of its models, and does VIO link them?"""

from collections.abc import Sequence

import numpy as np
import pandas as pd

from groundwalk.alignment.checks.results import CheckResult, Failure, Quantity, Rows, Subject, evaluate
from groundwalk.alignment.components import MAX_SCALE_SD, MAX_VERTICAL_SD, Component, PlacedComponent, Unlinked
from groundwalk.consistency.decisions import Status
from groundwalk.store.choices import CheckName, FailureCause

# A recording of which SfM registers less is of another scene.
_MIN_FRACTION_OF_SCENE = 0.1


def check_registration(
    frames: pd.DataFrame, registered: np.ndarray, recordings: dict[str, str], limit: float
) -> list[CheckResult]:
    """Registered frames of the dataset, without support frames: of the scene, and of each recording, as the few frames
    that a VIO jump cuts off decide nothing. The fractions are counts: they have no standard error."""
    dataset = np.flatnonzero(~frames["support"])
    count, total = int(registered[dataset].sum()), len(dataset)
    failure = Failure(cause=FailureCause.TOO_FEW_REGISTERED, reason=f"SfM registered {count} of {total} frames")
    results = [evaluate(CheckName.REGISTERED, Subject(total), Quantity(count / total), limit, failure)]
    recording = frames["session_id"].map(lambda session_id: recordings.get(session_id, session_id)).iloc[dataset]
    for _, places in frames.iloc[dataset].groupby(recording, sort=True).indices.items():
        rows = dataset[places]
        count, total = int(registered[rows].sum()), len(rows)
        sessions = sorted(set(frames["session_id"].iloc[rows]))
        is_other_scene = count < _MIN_FRACTION_OF_SCENE * total and registered.any()
        cause = FailureCause.OTHER_SCENE if is_other_scene else FailureCause.TOO_FEW_REGISTERED
        failure = Failure(cause, f"SfM registered {count} of the {total} frames of {', '.join(sessions)}")
        subject = Subject(total, sessions[0])
        results.append(evaluate(CheckName.SESSION_REGISTERED, subject, Quantity(count / total), limit, failure))
    return results


def missing_scale(index: int, rows: Rows, cause: FailureCause, reason: str) -> CheckResult:
    """The failed check of a model that can't be put into a metric map; `rows` are its registered frames."""
    failure = Failure(cause=cause, reason=reason, rows=rows)
    return evaluate(CheckName.COMPONENT_SCALE, Subject(len(rows), component=index), Quantity(), 0.0, failure)


def check_standard_errors(component: Component) -> list[CheckResult]:
    """The standard errors of a model's scale and vertical. A large one leaves them undecided, which lowers no frame's
    class: the headline and each frame's whole covariance have it."""
    scale, vertical, subject = component.scale, component.vertical, Subject(component.frames, component=component.index)
    by_reference, failure = scale.reference is not None, Failure(cause=FailureCause.UNCERTAIN, reason="")
    of_scale = CheckName.REFERENCE_SCALE if by_reference else CheckName.MAP_SCALE
    of_vertical = CheckName.REFERENCE_VERTICAL if by_reference else CheckName.MAP_VERTICAL
    return [
        evaluate(name, subject, Quantity(sd), limit, failure, Status.PASSED if sd <= limit else Status.UNDECIDED)
        for name, sd, limit in (
            (of_scale, scale.sd if scale.is_known else np.nan, MAX_SCALE_SD),
            (of_vertical, float(np.degrees(vertical.sd)), float(np.degrees(MAX_VERTICAL_SD))),
        )
    ]


def check_links(placed: Sequence[PlacedComponent], unlinked: Sequence[Unlinked], limit_m: float) -> list[CheckResult]:
    """How far VIO alone links each further model to the map: a known length, as what VIO drifts by there is in the
    frames' covariances. Frames of a model without a link get no ground truth."""
    results = []
    for component, link in ((p.component, p.link) for p in placed if p.link is not None):
        failure = Failure(cause=FailureCause.DISCONNECTED_SESSION, reason="")
        subject = Subject(component.frames, link.session_id, component.index)
        results.append(evaluate(CheckName.COMPONENT_LINK, subject, Quantity(link.gap_m), limit_m, failure))
    mapped = {s.recording for p in placed for s in p.component.segments if s.registered.any()}
    for component, gap_m, reason in unlinked:
        # A VIO jump splits a recording, too: its other session is of the same scene.
        is_elsewhere = gap_m is None and mapped.isdisjoint(s.recording for s in component.segments)
        cause = FailureCause.OTHER_SCENE if is_elsewhere else FailureCause.DISCONNECTED_SESSION
        failure = Failure(cause=cause, reason=reason, rows=component.registered_rows)
        subject = Subject(component.frames, component=component.index)
        results.append(evaluate(CheckName.COMPONENT_LINK, subject, Quantity(), limit_m, failure))
    return results
