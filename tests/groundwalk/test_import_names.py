"""Each module of the project has one name, groundwalk.<package>; pyproject.toml lists what a wheel holds."""

import importlib
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import groundwalk

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["setuptools"]
FOLDERS = {name: folder for name, folder in PROJECT["package-dir"].items() if folder not in ("groundwalk", "data")}
PROGRAM = """
import importlib, sys
for name in sys.stdin.read().split():
    importlib.import_module(name)
print(*sys.modules)
"""


def modules() -> list[str]:
    """The names of all modules in the folders that are packages of groundwalk."""
    names = ["groundwalk"]
    for package, folder in FOLDERS.items():
        for path in sorted((ROOT / folder).rglob("*.py")):
            parts = path.relative_to(ROOT / folder).with_suffix("").parts
            names.append(".".join((package, *(part for part in parts if part != "__init__"))))
    return names


def test_importing_everything_loads_nothing_under_a_second_name(tmp_path: Path) -> None:
    """From another folder, so that the checkout isn't on the path by chance."""
    names = modules()
    assert len(names) > 150
    command = [sys.executable, "-c", PROGRAM]
    done = subprocess.run(command, input=" ".join(names), capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    loaded = done.stdout.split()
    assert set(names) <= set(loaded)
    bare = set(FOLDERS.values())
    assert [name for name in loaded if name.split(".")[0] in bare] == []
    assert [name for name in loaded if name.startswith(("groundwalk.groundwalk", "groundwalk.tests"))] == []


def test_tests_can_load_nothing_under_a_second_name() -> None:
    for folder in FOLDERS.values():
        with pytest.raises(ImportError, match=f"imported as groundwalk.{folder}"):
            importlib.import_module(folder)
    assert [name for name in sys.modules if name.split(".")[0] in FOLDERS.values()] == []


def test_a_module_is_the_file_of_the_checkout() -> None:
    assert ROOT == groundwalk.CHECKOUT
    for name in ("groundwalk.geometry.poses", "groundwalk.store.schemas.sfm"):
        file = importlib.import_module(name).__file__
        assert file == str(ROOT / Path(*name.split(".")[1:]).with_suffix(".py"))


def test_groundwalk_itself_loads_no_library() -> None:
    command = "import sys; before = set(sys.modules); import groundwalk; print(*set(sys.modules) - before)"
    done = subprocess.run([sys.executable, "-c", command], capture_output=True, text=True, check=True, cwd=ROOT)
    assert {name.split(".")[0] for name in done.stdout.split()} <= {"groundwalk", *sys.stdlib_module_names}


def test_pyproject_lists_every_package() -> None:
    found = {"groundwalk", "groundwalk.data"}
    for package, folder in FOLDERS.items():
        for path in (ROOT / folder).rglob("__init__.py"):
            found.add(".".join((package, *path.parent.relative_to(ROOT / folder).parts)))
    assert found == set(PROJECT["packages"])
    at_top = {path.parent.name for path in ROOT.glob("*/__init__.py")} - {"groundwalk", "benchmarks"}
    assert at_top == set(FOLDERS.values())
