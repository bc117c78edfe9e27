"""Coverage-guided fuzzing of the readers: `make fuzz-import seconds=60`, or `python -m benchmarks.import_fuzz`.

Atheris (https://github.com/google/atheris, in the extra `fuzz`) changes the bytes of one file of a written capture and
keeps what reaches new code. Whatever comes out must be a sound import or an error that fits on a screen; anything else
ends the run, with the input that did it in `build/fuzz`.
"""

import os
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from groundwalk.store import UserError

try:
    import atheris
except ImportError:
    error = UserError("atheris isn't installed", do=".venv/bin/pip install -e '.[fuzz]'  (Linux, Python 3.11 or later)")
    raise SystemExit(f"error: {error}") from None

with atheris.instrument_imports(include=["groundwalk.capture_import"]):
    from groundwalk.capture_import.formats import FORMATS
    from tests.capture_import.capture_writers import WRITERS, make_walk
    from tests.capture_import.test_mutations import no_longer_than, read_all

FOUND = Path("build/fuzz")


class Target:
    """One file of one format's capture with other bytes; the first byte says which."""

    def __init__(self, folder: Path) -> None:
        self._work = folder / "case"
        self._whole = []
        self.runs = self.imported = 0
        for format in FORMATS.values():
            WRITERS[format.id].write(folder / format.id / "walk", make_walk(4))
            root = folder / format.id
            self._whole += [(root, path.relative_to(root)) for path in sorted(root.rglob("*")) if self._matters(path)]

    @staticmethod
    def _matters(path: Path) -> bool:
        """Logs, videos and archives, and one image of each capture: all images are read alike."""
        return path.is_file() and (path.suffix not in (".jpg", ".png") or "0000" in path.stem or path.stem == "0")

    def seeds(self) -> Iterator[bytes]:
        """The files as they were written."""
        for index, (root, name) in enumerate(self._whole):
            yield bytes([index]) + (root / name).read_bytes()

    def __call__(self, data: bytes) -> None:
        if not data:
            return
        root, name = self._whole[data[0] % len(self._whole)]
        shutil.rmtree(self._work, ignore_errors=True)
        shutil.copytree(root, self._work / "place")
        (self._work / "place" / name).write_bytes(data[1:])
        with no_longer_than(20, name):
            self.imported += read_all(self._work / "place", self._work / "unpacked")
        self.runs += 1


def main() -> None:
    """Fuzz for the seconds in the first argument (60); further arguments go to libFuzzer."""
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 60.0
    temporary = Path(tempfile.mkdtemp())
    target = Target(temporary / "captures")
    corpus = temporary / "corpus"
    corpus.mkdir()
    for index, seed in enumerate(target.seeds()):
        (corpus / str(index)).write_bytes(seed)
    FOUND.mkdir(parents=True, exist_ok=True)
    start = time.monotonic()

    def until_time_is_up(data: bytes) -> None:
        target(data)
        if time.monotonic() - start > seconds:
            print(f"{target.runs} inputs over {len(WRITERS)} formats, {target.imported} imported, no fault", flush=True)
            shutil.rmtree(temporary, ignore_errors=True)
            os._exit(0)  # libFuzzer takes any other end for a fault

    options = ["-max_len=65536", "-rss_limit_mb=4096", f"-artifact_prefix={FOUND}/"]
    atheris.Setup([sys.argv[0], str(corpus), *options, *sys.argv[2:]], until_time_is_up)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
