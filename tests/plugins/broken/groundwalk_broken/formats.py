from pathlib import Path

from groundwalk.capture_import.capture import Limits, Recording
from groundwalk.capture_import.formats import Format


def detect(path: Path) -> bool:
    raise RuntimeError("no idea")


def read(path: Path, limits: Limits) -> Recording:
    raise AssertionError("nothing is detected")


FAILS_TO_DETECT = Format(id="fails_to_detect", label="fails", meaning="nothing", files=(), detect=detect, read=read)
