"""Packages import what the graph below says, stages never each other; what is pure touches no files; each module has
one import name."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
# Which packages a package imports, beside itself. `groundwalk`, benchmarks and tests may import all of them.
GRAPH: dict[str, set[str]] = {
    "geometry": set(),
    "features": {"geometry"},
    "consistency": {"geometry"},
    "scoring": {"geometry"},
    "store": {"consistency", "geometry"},
    "simulation": {"store", "geometry"},
    "capture_import": {"store", "features", "geometry"},
    "sfm": {"store", "consistency", "features", "geometry"},
    "alignment": {"store", "consistency", "features", "geometry", "scoring"},
    "runtime": {"store", "geometry"},
    "export": {"store", "geometry", "runtime", "scoring", "training"},
    "training": {"store", "geometry", "scoring"},
    "localisation": {"store", "features", "geometry", "runtime", "scoring"},
    "fusion": {"store", "consistency", "geometry", "scoring"},
    "reports": {"store", "geometry", "scoring"},
}
OURS = set(GRAPH)
# What users of groundwalk call: above all packages.
FACE = {path.stem for path in (ROOT / "groundwalk").glob("*.py")} - {"__init__"} | {"open", "Run", "pose_array"}


def folder_of(package: str) -> Path:
    """A stage lies at the top, the shared library in groundwalk/."""
    return ROOT / package if (ROOT / package).is_dir() else ROOT / "groundwalk" / package


def imported(path: Path) -> set[str]:
    """The modules that a file imports, with the names that it imports from groundwalk itself."""
    modules = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            modules |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            whole = node.module == "groundwalk"
            modules |= {f"groundwalk.{alias.name}" for alias in node.names} if whole else {node.module}
    return modules


@pytest.mark.parametrize("package", sorted(GRAPH))
def test_package_imports_what_the_graph_says(package: str) -> None:
    """All that it may, too: a line of the graph that no import needs goes. And nothing of the command or the reader."""
    imports = set()
    for path in folder_of(package).rglob("*.py"):
        names = {module.split(".")[1] for module in imported(path) if module.startswith("groundwalk.")}
        crossing = names & (OURS | FACE) - GRAPH[package] - {package}
        assert not crossing, f"{path.relative_to(ROOT)} imports {', '.join(sorted(crossing))} of groundwalk"
        imports |= names & OURS
    assert imports - {package} == GRAPH[package]


@pytest.mark.parametrize("package", ["geometry", "consistency", "scoring"])
def test_package_is_pure(package: str) -> None:
    for path in folder_of(package).rglob("*.py"):
        roots = {module.split(".")[0] for module in imported(path)}
        io = roots & {"pathlib", "os", "io", "json", "pandas", "pyarrow", "rerun", "cv2", "open3d", "torch"}
        assert not io, f"{path.relative_to(ROOT)} imports {', '.join(sorted(io))}"


ANY_OF_OURS = f"(?:{'|'.join(sorted(OURS))})\\b"
BARE = [
    # A command: python -m ..., or the same as a list of arguments.
    re.compile(rf"""-m[\s"',]+{ANY_OF_OURS}(?!/)"""),
    # An import, also in a program that a string holds.
    re.compile(rf"""(?:^|;|\\n|["'])\s*from\s+{ANY_OF_OURS}[.\w]*\s+import\b""", re.MULTILINE),
    re.compile(rf"""(?:^|;|\\n|["'])\s*import\s+(?:[.\w]+,\s*)*{ANY_OF_OURS}\s*(?:$|[.,;])""", re.MULTILINE),
    re.compile(rf"""import_module\(f?["']{ANY_OF_OURS}"""),
]


def test_each_package_is_named_groundwalk() -> None:
    """Under another name a module would be loaded twice, or be another installation's."""
    folders = {folder_of(package) for package in OURS} | {ROOT / name for name in ("groundwalk", "benchmarks", "tests")}
    paths = {path for folder in folders for path in folder.rglob("*.py")}
    assert len(paths) > 200
    for path in (*paths, *ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), ROOT / "Makefile"):
        text = path.read_text(encoding="utf-8")
        found = [match.group().strip() for bare in BARE for match in bare.finditer(text)]
        assert not found, f"{path.relative_to(ROOT)}: {found[0]}: the package's name is groundwalk.<package>"
