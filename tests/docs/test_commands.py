"""Every command in the docs is executed, or the page says why not; each names what there is."""

import importlib.util
import os
import re
import shutil
import subprocess
import tomllib
from pathlib import Path

import nbclient
import nbformat
import pytest

from groundwalk.cli import all_commands
from groundwalk.store import DataRoot
from groundwalk.store.settings import resolve_settings
from tests.docs.pages import COMMAND, NOT_RUN, ROOT, Block, Page, pages

PAGES = pages()
COMMANDS = {command.name: command for command in all_commands()}
TARGETS = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
NOTEBOOK = "docs/tutorials/first_look.ipynb"
OPTIONS_OF_ALL = {"--help", "--version", "--install-completion", "--show-completion"}


def is_to_run(block: Block) -> bool:
    if block.reason_not_run or block.is_listing:
        return False
    return block.language in ("sh", "python") or block.settings_file is not None


RUN = [page for page in PAGES if any(is_to_run(b) and b.language != "toml" for b in page.blocks)]


def test_commands_are_shown_in_blocks_that_a_test_sees() -> None:
    assert sum(is_to_run(block) for page in PAGES for block in page.blocks) > 20
    for page in PAGES:
        for line in page.text.splitlines():
            is_indented = re.match(r"^(?: {4,}|\t)(?=\S)", line)
            assert not (is_indented and COMMAND.match(line.strip())), f"{page.name}: put into a block of sh: {line}"
        for block in page.blocks:
            assert block.language, f"{page.name}: a block without a language: {block.text[:60]}"
            if block.language not in ("sh", "python"):
                shown = [line for line in block.text.splitlines() if COMMAND.match(line)]
                assert not shown, f"{page.name}: a command in a block of {block.language}: {shown[0]}"


def test_every_mark_stands_before_a_block() -> None:
    for page in PAGES:
        marked = sum(block.reason_not_run is not None for block in page.blocks)
        assert marked == len(NOT_RUN.findall(page.text)), page.name
        assert page.text.count("<!-- not run") == marked, f"{page.name}: a mark without a reason"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_each_command_names_what_there_is(page: Page) -> None:
    for words in page.commands:
        program, *arguments = words
        program = program.removeprefix(".venv/bin/")
        if program == "make":
            goals = [word for word in arguments if "=" not in word and word not in ("…", "...")]
            assert set(goals) <= TARGETS, f"{page.name}: no target {goals}"
        elif program == "groundwalk" and arguments and not arguments[0].startswith(("-", "<")):
            assert arguments[0] in COMMANDS, f"{page.name}: no command {arguments[0]}"
            loaded, rest = COMMANDS[arguments[0]].load(), arguments[1:]
            while rest and rest[0] in getattr(loaded, "commands", {}):
                loaded = loaded.commands[rest.pop(0)]
            known = {name for parameter in loaded.params for name in parameter.opts}
            own = arguments[: arguments.index("--")] if "--" in arguments else arguments  # and another program's
            options = {word.partition("=")[0] for word in own if word.startswith("--")}
            assert options <= known | OPTIONS_OF_ALL, f"{page.name}: {words}: no {options - known}"
        elif program.startswith("python") and re.match(r"-m (groundwalk|benchmarks)\b", " ".join(arguments)):
            assert importlib.util.find_spec(arguments[1]), f"{page.name}: no module {arguments[1]}"


def test_settings_that_pages_show_are_valid(tmp_path: Path) -> None:
    shown = [(page, b) for page in PAGES for b in page.blocks if b.settings_file and not b.reason_not_run]
    assert len(shown) > 3
    models = {command.name: command.stage().settings for command in COMMANDS.values() if command.is_stage}
    for index, (page, block) in enumerate(shown):
        folder = tmp_path / str(index)
        (folder / "scenes").mkdir(parents=True)
        (folder / "scenes" / "Shown.toml").write_text(block.text, encoding="utf-8")
        sections = tomllib.loads(block.text)
        assert sections, page.name
        for stage, model in models.items():
            resolve_settings(model, stage, DataRoot(folder), "tiny", "Shown", [])


@pytest.fixture(scope="session")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the tree, in which every profile is as small as tiny, after the README's first command."""
    tree = tmp_path_factory.mktemp("tree") / "groundwalk"
    listed = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    for name in subprocess.run(listed, cwd=ROOT, capture_output=True, check=True).stdout.decode().split("\0"):
        if name and ((ROOT / name).is_file() or (ROOT / name).is_symlink()):
            (tree / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, tree / name, follow_symlinks=False)
    tiny = tree / "shipped" / "profiles" / "tiny.toml"
    for profile in tiny.parent.glob("*.toml"):
        if profile != tiny:
            shutil.copy(tiny, profile)
    (tree / ".venv").symlink_to((ROOT / ".venv").resolve())
    execute(Block("sh", "make scene=Church all", ""), tree)
    # What the tutorials call ~/captures/library: the same walks, without what says that they are simulated.
    library = tree.parent / "captures" / "library"
    shutil.copytree(tree / "data" / "captures" / "Church", library, ignore=shutil.ignore_patterns("*.parquet", "S*"))
    return tree


def execute(block: Block, tree: Path) -> None:
    """Run a block as a reader would who stands in the tree, with ~ beside it; TOML is added to the file it names."""
    if block.settings_file:
        (tree / block.settings_file).parent.mkdir(exist_ok=True)
        with (tree / block.settings_file).open("a", encoding="utf-8") as file:
            file.write("\n" + block.text)
        return
    command = ["bash", "-eu", "-o", "pipefail", "-c", block.text]
    if block.language == "python":
        command = [str(tree / ".venv" / "bin" / "python"), "-c", block.text]
    path = os.pathsep.join([str(tree / ".venv" / "bin"), os.environ["PATH"]])
    environment = {**os.environ, "PATH": path, "PYTHONPATH": str(tree), "HOME": str(tree.parent), "MPLBACKEND": "agg"}
    done = subprocess.run(command, cwd=tree, env=environment, capture_output=True, text=True, timeout=1800)
    assert done.returncode == 0, f"{block.text}\n{done.stdout[-2000:]}\n{done.stderr[-3000:]}"


@pytest.mark.slow
@pytest.mark.parametrize("page", RUN, ids=lambda page: page.name)
def test_what_a_page_shows_runs(page: Page, finished: Path, tmp_path: Path) -> None:
    tree = shutil.copytree(finished, tmp_path / "groundwalk", symlinks=True, copy_function=linked)
    (tmp_path / "captures").symlink_to(finished.parent / "captures")
    for block in page.blocks:
        if is_to_run(block):
            execute(block, tree)


def linked(source: str, target: str) -> None:
    """A hard link where nothing is written in place, a copy of what pages change."""
    if "/data/runs/" in source or "/data/captures/" in source:
        os.link(source, target)
    else:
        shutil.copy2(source, target)


def test_the_notebook_has_no_outputs() -> None:
    cells = nbformat.read(ROOT / NOTEBOOK, as_version=4).cells
    assert not any(cell.get("outputs") or cell.get("execution_count") for cell in cells), "clear them before a commit"


@pytest.mark.slow
def test_the_notebook_runs_as_it_is(finished: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", str(finished))
    notebook = nbformat.read(finished / NOTEBOOK, as_version=4)
    resources = {"metadata": {"path": str(finished)}}
    nbclient.NotebookClient(notebook, timeout=300, kernel_name="python3", resources=resources).execute()
