"""Each module of the project has one name, groundwalk.<package>, wherever its folder lies."""

import importlib
import subprocess
import sys
from pathlib import Path

from groundwalk.store.checkout import CHECKOUT

ROOT = Path(__file__).resolve().parents[2]


def test_a_module_is_the_file_of_the_checkout() -> None:
    assert ROOT == CHECKOUT
    for name in ("groundwalk.geometry.poses", "groundwalk.store.schemas.sfm", "groundwalk.sfm.stage"):
        file = importlib.import_module(name).__file__
        assert file == str(ROOT / Path(*name.split(".")).with_suffix(".py"))


def test_groundwalk_itself_loads_no_library() -> None:
    command = "import sys; before = set(sys.modules); import groundwalk; print(*set(sys.modules) - before)"
    done = subprocess.run([sys.executable, "-c", command], capture_output=True, text=True, check=True, cwd=ROOT)
    assert {name.split(".")[0] for name in done.stdout.split()} <= {"groundwalk", *sys.stdlib_module_names}
