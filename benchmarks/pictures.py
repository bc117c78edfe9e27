"""`python -m benchmarks.pictures`: the docs' page.jpg, the first screen of a report's page, and recordings.jpg."""

import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import typer
from rerun.experimental import ViewerClient

from groundwalk.store.cli import DataOption, ProfileOption, new_app
from groundwalk.store.errors import UserError
from groundwalk.store.files import RECORDING
from groundwalk.store.hints import run_command
from groundwalk.store.images import Image
from groundwalk.store.settings import DataRoot

app = new_app("Pictures of the docs.")
BROWSERS = ("chromium", "chromium-browser", "google-chrome")


_SHOWN = ("import", "sfm", "align", "fuse")
_PORT = 9971
_SETTLE_S = 5.0  # until the viewer has drawn all
_TILE = (800, 450)


@app.command()
def pictures(
    scene: Annotated[str, typer.Option(help="The scene; its captures must be ones that may be shown.")] = "Church",
    profile: ProfileOption = "demo",
    data: DataOption = Path("data"),
    out: Annotated[Path, typer.Option(help="The folder of the pictures.")] = Path("docs/images"),
) -> None:
    """Photograph the top of a page, as a browser shows it, and recordings in Rerun's viewer."""
    run = DataRoot(data).run(profile, scene)
    needed = [run / "report" / "page.html", *(run / stage / RECORDING for stage in _SHOWN)]
    for file in needed:
        if not file.is_file():
            raise UserError("there is nothing to photograph", where=file, do=run_command(file.parent))
    out.mkdir(parents=True, exist_ok=True)  # OpenCV writes into no folder that is missing, and says nothing
    for name, picture in (("page", _page(needed[0])), ("recordings", _recordings(needed[1:]))):
        cv2.imwrite(str(out / f"{name}.jpg"), picture, [cv2.IMWRITE_JPEG_QUALITY, 88])
        print(out / f"{name}.jpg")


def _page(file: Path) -> Image:
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        raise UserError("there is no browser", expected=f"one of {', '.join(BROWSERS)}", do="apt-get install chromium")
    with tempfile.TemporaryDirectory() as folder:
        shot = Path(folder, "page.png")
        options = ["--headless", "--no-sandbox", "--hide-scrollbars", "--window-size=1280,1080", f"--screenshot={shot}"]
        subprocess.run([browser, *options, file.resolve().as_uri()], check=True, capture_output=True)
        return _decoded(shot.read_bytes())


def _recordings(files: list[Path]) -> Image:
    """Each recording in the middle of its walk, two beside two. Needs Vulkan (apt-get install mesa-vulkan-drivers)."""
    tiles = []
    for number, file in enumerate(files):
        viewer_file = str(Path(sys.executable).with_name("rerun"))
        with ViewerClient.spawn(headless=True, port=_PORT + number, executable_path=viewer_file) as viewer:
            viewer.open(str(file.resolve()))
            viewer.set_time("time", duration=30, play_state="paused")
            time.sleep(_SETTLE_S)
            tiles.append(cv2.resize(_decoded(viewer.take_screenshot()), _TILE, interpolation=cv2.INTER_AREA))
    return np.vstack([np.hstack(tiles[:2]), np.hstack(tiles[2:])])


def _decoded(png: bytes) -> Image:
    picture = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    if picture is None:
        raise RuntimeError("no picture was taken")
    return np.asarray(picture, np.uint8)


if __name__ == "__main__":
    app()
