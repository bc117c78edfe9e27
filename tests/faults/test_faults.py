"""A small part of `make test-faults`: damaged imports, hostile names and texts; and its own judgement."""

import random
from pathlib import Path

import pytest

from benchmarks.faults import artefacts, names, rooms
from benchmarks.faults.case import Case
from benchmarks.faults.sandbox import SCENE, Sandbox, digest, make_sandbox, run_case

# isort: split
from tests.capture_import.capture_writers import WRITERS, make_walk

SEED, COUNT = 0, 4
KINDS = (
    "artefact damaged",
    "manifest damaged",
    "name",
    "image damaged",
    "link",
    "error",
    "setting",
    "closed",
    "mount point",
    "path in a table",
    "text",
)


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Sandbox:
    """A scene that is imported."""
    folder = tmp_path_factory.mktemp("faults") / "base"
    WRITERS["frames_jsonl"].write(folder / "data" / "captures" / SCENE / "walk", make_walk(20))
    return make_sandbox(folder, ("import",))


def drawn(base: Sandbox, kind: str) -> list[Case]:
    cases = [
        *artefacts.cases(base),
        *artefacts.image_cases(),
        *names.cases(),
        *rooms.cases(base),
    ]
    of_kind = [case for case in cases if case.kind.startswith(kind)]
    if kind in ("error", "closed"):  # others fail for want of what a base that is only imported doesn't have
        of_kind = [case for case in of_kind if case.writes == "import"]
    return random.Random(SEED).sample(of_kind, min(COUNT, len(of_kind)))


@pytest.mark.parametrize("kind", KINDS)
def test_faults_end_in_a_sentence_and_change_nothing(base: Sandbox, tmp_path: Path, kind: str) -> None:
    cases = drawn(base, kind)
    assert cases
    for case in cases:
        outcome = run_case(case, base, tmp_path / "case", digest(f"{SEED} {case.name}"))
        assert not outcome.problems, f"{case.name} ({outcome.done}): {outcome.problems}\n{outcome.text}"
