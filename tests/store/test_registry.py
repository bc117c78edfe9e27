"""Records by entry points: groundwalk's own, those of other packages, and what is wrong with either."""

import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import pytest

from groundwalk.capture_import.formats import FORMATS
from groundwalk.fusion.methods import METHODS
from groundwalk.sfm.plugins import MAPPERS
from groundwalk.store import UserError, registry
from groundwalk.store.builtin import BUILTIN
from groundwalk.store.registry import Entry, PluginError, Registry, callable_faults
from groundwalk.training.regressors import REGRESSORS

GROUP = "groundwalk.hats"


@dataclass(frozen=True, kw_only=True)
class Hat(Entry):
    noun: ClassVar[str] = "hat"

    brim: Callable[[], int]

    def faults(self) -> Iterable[str]:
        yield from super().faults()
        yield from callable_faults(self, ["brim"])


BOWLER = Hat(id="bowler", label="Bowler", meaning="round", brim=lambda: 5)
TOP = replace(BOWLER, id="top", label="Top hat")
FEZ = Hat(id="fez", label="Fez", meaning="without a brim", brim=lambda: 1 // 0)
NAMELESS = replace(FEZ, id="a hat!", label=None)  # type: ignore[arg-type]
BRIMLESS = replace(FEZ, id="brimless", brim=3)  # type: ignore[arg-type]

Install = Callable[..., Registry[Hat]]


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Install:
    """A function that installs packages, each with its entry points, and gives a registry of hats."""
    here = __name__
    monkeypatch.setitem(sys.modules, here, sys.modules[__name__])
    monkeypatch.setitem(BUILTIN, GROUP, {"top": f"{here}:TOP", "bowler": f"{here}:BOWLER"})
    monkeypatch.syspath_prepend(str(tmp_path))

    def make(**packages: dict[str, str]) -> Registry[Hat]:
        for package, points in packages.items():
            folder = tmp_path / f"{package}-2.1.dist-info"
            folder.mkdir()
            (folder / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 2.1\n")
            lines = [f"{name} = {value.replace('HERE', here)}" for name, value in points.items()]
            (folder / "entry_points.txt").write_text("\n".join([f"[{GROUP}]", *lines]) + "\n")
        return Registry(GROUP, Hat)

    return make


def test_own_entries_need_no_installed_metadata_and_keep_their_order(install: Install) -> None:
    """As in a checkout whose installation is older; nor does an older installation add or replace anything."""
    hats = install(
        groundwalk={"cap": "groundwalk.no_longer_there:CAP", "top": "groundwalk.old:TOP"}, zeta={"fez": "HERE:FEZ"}
    )
    assert list(hats) == ["top", "bowler", "fez"] and hats["top"] is TOP and not hats.problems
    assert hats.builtin == ("top", "bowler")
    assert hats.versions() == hats.versions(["top", "fez"]) == {"fez": "zeta 2.1"}


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("sun", "no.such.module:SUN", "can't be imported: ModuleNotFoundError: No module named 'no'"),
        ("sun", "HERE:SUN", "can't be imported: AttributeError"),
        ("sun", "HERE:GROUP", "it is a str, not a"),
        ("sun", "HERE:FEZ", "its id is 'fez', not the entry point's name"),
        ("bowler", "HERE:BOWLER", "its id is taken: package groundwalk"),
        ("a hat!", "HERE:NAMELESS", "id is 'a hat!', not 1 to 40 letters"),
        ("brimless", "HERE:BRIMLESS", "brim is 3, not a function"),
    ],
)
def test_an_entry_with_a_fault_is_named_and_the_others_stay(
    install: Install, capsys: pytest.CaptureFixture[str], name: str, value: str, reason: str
) -> None:
    hats = install(acme={name: value}, zeta={"fez": "HERE:FEZ"})
    assert list(hats) == ["top", "bowler", "fez"]
    said = capsys.readouterr().err
    assert said.count("warning") == 1 and reason in said
    assert f"package acme 2.1, entry point {GROUP}: {name} = " in said


def test_what_is_asked_for_and_cannot_be_used(install: Install) -> None:
    hats = install(acme={"sun": "no.such.module:SUN"})
    with pytest.raises(UserError, match=r"there is no hat 'moon'[\s\S]*one of top, bowler"):
        hats.find("moon")
    with pytest.raises(PluginError, match=r"package acme 2\.1, entry point[\s\S]*No module named"):
        hats.known("sun")


def test_faults_of_a_package_are_named_and_ours_are_not_hidden(install: Install) -> None:
    hats = install(acme={"fez": "HERE:FEZ"})
    with (
        pytest.raises(PluginError, match=r"hat 'fez' failed[\s\S]*acme 2\.1[\s\S]*ZeroDivisionError") as caught,
        hats.guard("fez"),
    ):
        hats["fez"].brim()
    with pytest.raises(ZeroDivisionError), hats.guard("top"):
        raise ZeroDivisionError
    with pytest.raises(UserError, match=r"^no picture$"), hats.guard("fez"):
        raise UserError("no picture")
    # A stage's process may hand it to another.
    reduced: Any = caught.value.__reduce__()  # which may be a text as well, by its type
    made, arguments = reduced
    again = made(*arguments)
    assert type(again) is PluginError and str(again) == str(caught.value) and again.reason == caught.value.reason


@pytest.mark.parametrize("kind", [FORMATS, MAPPERS, REGRESSORS, METHODS], ids=lambda kind: kind.group)
def test_all_of_our_entries_are_sound(kind: Registry[Entry]) -> None:
    assert len(kind.builtin) and [*kind][: len(kind.builtin)] == [*kind.builtin]
    for name in kind.builtin:
        assert isinstance(kind[name], kind.record)
        assert kind[name].id == name and not list(kind[name].faults())
    assert registry.BUILTIN.keys() >= {kind.group}
