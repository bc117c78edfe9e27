"""Has each SfM model a scale and a vertical, how certain are they, and does VIO link it to the map?"""

from collections.abc import Sequence

import numpy as np

from groundwalk.alignment.checks.results import NO_ROWS, CheckResult, Failure, Quantity, Subject, evaluate
from groundwalk.alignment.components import Component, ModelSegments, PlacedComponent
from groundwalk.alignment.settings import AlignSettings
from groundwalk.alignment.vio_links import UnlinkedComponent
from groundwalk.consistency.decisions import Status
from groundwalk.store.choices import CheckName, FailureCause


def missing_scale(index: int, model: ModelSegments, cause: FailureCause, reason: str) -> CheckResult:
    """The failed check of a model that can't be put into a metric map."""
    failure = Failure(cause=cause, reason=reason, rows=model.registered_rows)
    return evaluate(CheckName.COMPONENT_SCALE, Subject(len(failure.rows), component=index), Quantity(), 0.0, failure)


def check_standard_errors(component: Component, settings: AlignSettings) -> list[CheckResult]:
    """The standard errors of a model's scale and vertical. A large one leaves them undecided, which lowers no frame's
    class: the headline and each frame's whole covariance have it."""
    scale, vertical, results = component.scale, component.vertical, []
    names = (
        (CheckName.REFERENCE_SCALE, CheckName.REFERENCE_VERTICAL)
        if scale.reference
        else (CheckName.MAP_SCALE, CheckName.MAP_VERTICAL)
    )
    sds = scale.sd if scale.is_known else np.nan, float(np.degrees(vertical.sd))
    limits = settings.max_scale_sd, settings.max_vertical_sd_deg
    for name, sd, limit in zip(names, sds, limits, strict=True):
        subject = Subject(component.frames, component=component.index)
        failure = Failure(cause=FailureCause.UNCERTAIN, reason="")
        status = Status.PASSED if sd <= limit else Status.UNDECIDED
        results.append(evaluate(name, subject, Quantity(sd), limit, failure, status))
    return results


def check_links(
    placed: Sequence[PlacedComponent], unlinked: Sequence[UnlinkedComponent], settings: AlignSettings
) -> list[CheckResult]:
    """How far VIO alone links each further model to the map: a known length, as what VIO drifts by there is in the
    frames' covariances. Frames of a model without a link get no ground truth."""
    results = []
    for each in placed[1:]:
        if each.link is not None:
            subject = Subject(each.component.frames, each.link.session_id, each.component.index)
            results.append(_check_link(subject, Quantity(each.link.gap_m), FailureCause.DISCONNECTED_SESSION, settings))
    mapped = {s.recording for p in placed for s in p.component.segments if s.registered.any()}
    for component, gap_m, reason in ((u.component, u.gap_m, u.reason) for u in unlinked):
        # A VIO jump parts a recording, too: its other part is of the same scene.
        is_elsewhere = gap_m is None and mapped.isdisjoint(s.recording for s in component.segments)
        cause = FailureCause.OTHER_SCENE if is_elsewhere else FailureCause.DISCONNECTED_SESSION
        subject, rows = Subject(component.frames, component=component.index), component.registered_rows
        results.append(_check_link(subject, Quantity(), cause, settings, reason, rows))
    return results


def _check_link(
    subject: Subject,
    gap_m: Quantity,
    cause: FailureCause,
    settings: AlignSettings,
    reason: str = "",
    rows: np.ndarray = NO_ROWS,
) -> CheckResult:
    failure = Failure(cause=cause, reason=reason, rows=rows)
    return evaluate(CheckName.COMPONENT_LINK, subject, gap_m, settings.vio_link_m, failure)
