"""A wheel of the tree: what it puts into site-packages, and that it works from outside the checkout."""

import os
import shutil
import subprocess
import sys
import sysconfig
import venv
from collections.abc import Callable
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
Run = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture(scope="module")
def site_packages(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Those of a new environment with the wheel alone, which sees the libraries that are installed here."""
    for tool in ("setuptools", "pip"):
        pytest.importorskip(tool, reason=f"a wheel is built with {tool}, which isn't installed here")
    if not (ROOT / ".git").exists():
        pytest.skip("which files are the project's is asked of git, and this isn't a clone")
    folder = tmp_path_factory.mktemp("wheel")
    # Building writes into the tree.
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    for name in filter(None, listed.split("\0")):
        if (ROOT / name).is_file() or (ROOT / name).is_symlink():
            (folder / "tree" / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(ROOT / name, folder / "tree" / name, follow_symlinks=False)
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check"]
    build = [*pip, "wheel", "--quiet", "--no-deps", "--no-build-isolation", "--wheel-dir"]
    subprocess.run([*build, folder, folder / "tree"], check=True, env=without_python_path())
    venv.create(folder / "environment", symlinks=True)
    python = folder / "environment" / "bin" / "python"
    (wheel,) = folder.glob("groundwalk-*.whl")
    # An editable installation leaves its metadata in the tree, which PYTHONPATH names: pip would find it installed.
    install: list[str | Path] = [*pip, "--python", python, "install", "--quiet", "--no-deps", wheel]
    subprocess.run(install, check=True, env=without_python_path())
    (found,) = (folder / "environment").glob("lib/python*/site-packages")
    return found


def without_python_path() -> dict[str, str]:
    return {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}


@pytest.fixture(scope="module")
def run(site_packages: Path, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Runs a program of the environment in an empty folder; the libraries of this Python come last on its path.

    They come by a .pth file, so that other .pth files there, as of an editable installation, aren't read.
    """
    (site_packages / "libraries.pth").write_text(sysconfig.get_path("purelib") + "\n")
    work = tmp_path_factory.mktemp("work")

    def run(program: str, *arguments: str) -> subprocess.CompletedProcess[str]:
        command = [str(site_packages.parents[2] / "bin" / program), *arguments]
        return subprocess.run(command, capture_output=True, text=True, cwd=work, env=without_python_path())

    return run


def test_a_wheel_brings_groundwalk_and_nothing_else(site_packages: Path) -> None:
    names = {path.name for path in site_packages.iterdir()} - {"libraries.pth"}
    (info,) = (name for name in names if name.endswith(".dist-info"))
    assert names == {"groundwalk", info} and info.startswith("groundwalk-")
    for folder in ("profiles", "scenes", "published"):
        shipped = {path.name for path in (site_packages / "groundwalk" / "shipped" / folder).iterdir()}
        assert shipped == {path.name for path in (ROOT / "shipped" / folder).iterdir() if path.is_file()}
    assert not (site_packages / "groundwalk" / "data").exists()
    assert not any((site_packages / "groundwalk" / name).exists() for name in ("tests", "benchmarks", "docs"))


def test_the_installed_command_works_outside_the_checkout(run: Run) -> None:
    done = run("groundwalk", "--help")
    assert done.returncode == 0 and "simulate" in done.stdout, done.stderr
    done = run("groundwalk", "scenes")
    assert {"demo", "standard", "paper", "tiny", "Church", "outdoor"} <= set(done.stdout.split()), done.stderr
    done = run("python", "-c", "from groundwalk.store import checkout; print(checkout.CHECKOUT, checkout.__file__)")
    assert done.stdout.split()[0] == "None" and str(ROOT) not in done.stdout
    done = run("python", "-c", "import groundwalk; groundwalk.open('Church')")
    assert "groundwalk run --scene Church --profile demo --until report" in done.stderr


@pytest.mark.slow
def test_an_installed_groundwalk_makes_a_scene_and_reads_it(run: Run) -> None:
    done = run("groundwalk", "run", "--scene", "Church", "--profile", "tiny")
    assert done.returncode == 0, done.stderr[-3000:]
    again = run("groundwalk", "run", "--scene", "Church", "--profile", "tiny")
    stages = ("simulate", "import", "sfm", "align", "localise", "train", "fuse", "report")
    assert [f"{stage} · Church · tiny: up to date" in again.stderr for stage in stages] == [True] * 8, again.stderr
    assert again.stderr.count("up to date") == len(stages), again.stderr
    program = (
        "import groundwalk; run = groundwalk.open('Church', profile='tiny'); print(run.summary());"
        "print(run.image(run.frames['frame_id'][0]).shape, len(run.points) > 0, len(run.errors) > 0)"
    )
    done = run("python", "-c", program)
    assert "SIMULATED captures" in done.stdout and "(240, 320, 3) True True" in done.stdout, done.stderr
