"""The hand-written pages and what they show: blocks of commands, Python and settings, and commands in running text."""

import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
GENERATED = {"tables.md", "settings.md", "commands.md", "checks.md"}
NOT_RUN = re.compile(r"<!-- not run: (\S.*?) -->")
# A file of the example package, which tests/plugins runs and compares with the page.
LISTING = re.compile(r"`tests/plugins/example/\S+`:")
FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
COMMAND = re.compile(r"^(?:\$ )?(?:\.venv/bin/)?(?:make|groundwalk|python3? -m|pip)(?= |$)")


@dataclass(frozen=True)
class Block:
    """A fenced block: its language, its text, and the line before it."""

    language: str
    text: str
    before: str

    @property
    def reason_not_run(self) -> str | None:
        """Why it isn't executed by a test, where the page says so."""
        said = NOT_RUN.fullmatch(self.before)
        return said.group(1) if said else None

    @property
    def is_listing(self) -> bool:
        return LISTING.fullmatch(self.before) is not None

    @property
    def settings_file(self) -> str | None:
        """The file that a block of TOML goes into, named in its first line."""
        named = re.match(r"# (data/\S+\.toml)\n", self.text)
        return named.group(1) if self.language == "toml" and named else None


@dataclass(frozen=True)
class Page:
    path: Path

    @property
    def name(self) -> str:
        return str(self.path.relative_to(ROOT))

    @cached_property
    def text(self) -> str:
        return self.path.read_text(encoding="utf-8")

    @cached_property
    def blocks(self) -> list[Block]:
        found = []
        for match in FENCE.finditer(self.text):
            above = self.text[: match.start()].rstrip().rpartition("\n")[2]
            found.append(Block(match.group(1), match.group(2), above))
        return found

    @property
    def commands(self) -> Iterator[list[str]]:
        """Every command that the page shows, in a block or in running text, as words."""
        for block in self.blocks:
            if block.language == "sh":
                joined = block.text.replace("\\\n", " ")
                yield from (shlex.split(line, comments=True) for line in joined.splitlines() if COMMAND.match(line))
        prose = FENCE.sub("", self.text)
        for span in re.findall(r"`([^`]+)`", prose):
            one_line = " ".join(span.split())
            if COMMAND.match(one_line):
                yield shlex.split(one_line)


def pages() -> list[Page]:
    """README, CONTRIBUTING and docs, without what commands write."""
    paths = [p for p in (ROOT / "docs").rglob("*.md") if p.name not in GENERATED and p.parent.name != "results"]
    return [Page(path) for path in (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted(paths))]
