"""A stage imports geometry, artefacts and itself, never another stage; geometry touches no files."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
STAGES = {"capture_import", "sfm", "alignment", "training", "fusion", "reports", "simulation"}
ALLOWED = {"geometry": {"geometry"}, "artefacts": {"artefacts", "geometry"}} | {
    stage: {stage, "artefacts", "geometry"} for stage in STAGES
}
OURS = STAGES | {"geometry", "artefacts"}


def imported(path: Path) -> set[str]:
    """Top-level names of the modules that a file imports."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names.add(node.module.split(".")[0])
    return names


@pytest.mark.parametrize("package", sorted(ALLOWED))
def test_package_imports_only_what_its_layer_may(package: str) -> None:
    files = list((ROOT / package).rglob("*.py"))
    assert files
    for path in files:
        crossing = (imported(path) & OURS) - ALLOWED[package]
        assert not crossing, f"{path.relative_to(ROOT)} imports {', '.join(sorted(crossing))}"


def test_geometry_is_pure() -> None:
    for path in (ROOT / "geometry").rglob("*.py"):
        io = imported(path) & {"pathlib", "os", "io", "json", "pandas", "pyarrow", "rerun", "cv2", "open3d", "torch"}
        assert not io, f"{path.relative_to(ROOT)} imports {', '.join(sorted(io))}"
