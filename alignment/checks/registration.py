"""Did SfM register enough frames, of all and of each recording?"""

import numpy as np
import pandas as pd

from groundwalk.alignment.checks.results import CheckResult, Failure, Quantity, Subject, evaluate
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
        failure = Failure(
            cause=FailureCause.OTHER_SCENE if is_other_scene else FailureCause.TOO_FEW_REGISTERED,
            reason=f"SfM registered {count} of the {total} frames of {', '.join(sessions)}",
        )
        subject = Subject(total, sessions[0])
        results.append(evaluate(CheckName.SESSION_REGISTERED, subject, Quantity(count / total), limit, failure))
    return results
