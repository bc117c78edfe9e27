"""`make docs-site` builds without a warning: each link and anchor leads somewhere, each page is in the navigation."""

import os
import re
import subprocess
import sys
from pathlib import Path

from tests.docs.pages import ROOT, pages


def test_the_site_builds_strictly(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(tmp_path / "site")]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr
    built = tmp_path / "site"
    assert (built / "index.html").is_file() and (built / "reference" / "settings.html").is_file()
    fetched = re.findall(
        r'<(?:script|link|img)[^>]*(?:src|href)="(https?://[^"]+)"', (built / "index.html").read_text()
    )
    assert not fetched, "a page fetches from elsewhere"


def test_pages_at_the_top_link_to_files_that_there_are() -> None:
    """README and CONTRIBUTING, which the site doesn't hold; and paths of docs in code."""
    for page in pages():
        if page.path.parent == ROOT:
            for target in re.findall(r"\]\(([^)#]+)\)", page.text):
                assert target.startswith("http") or (ROOT / target).exists(), f"{page.name}: {target}"
    sources = [*ROOT.glob("*/**/*.py"), *ROOT.glob("data/**/*.md"), ROOT / "Makefile"]
    for source in sources:
        if ".venv" not in source.parts and "build" not in source.parts:
            for named in re.findall(r"(?<![\w/])docs/[\w./-]+\.md\b", source.read_text(encoding="utf-8")):
                is_written_later = named == "docs/results/phone-cameras.md"
                assert is_written_later or (ROOT / named).exists(), f"{source}: {named}"
