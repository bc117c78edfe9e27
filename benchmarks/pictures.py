"""`python -m benchmarks.pictures`: docs/images/page.jpg, the first screen of a finished report's page."""

import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Annotated

import cv2
import typer

from groundwalk.store.cli import DataOption, ProfileOption, new_app
from groundwalk.store.errors import UserError
from groundwalk.store.hints import run_command
from groundwalk.store.settings import DataRoot

app = new_app("Pictures of the docs.")
BROWSERS = ("chromium", "chromium-browser", "google-chrome")


@app.command()
def page(
    scene: Annotated[str, typer.Option(help="The scene; its captures must be ones that may be shown.")] = "Church",
    profile: ProfileOption = "demo",
    data: DataOption = Path("data"),
    out: Annotated[Path, typer.Option(help="The picture.")] = Path("docs/images/page.jpg"),
) -> None:
    """Photograph the top of a page, as a browser shows it."""
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        raise UserError("there is no browser", expected=f"one of {', '.join(BROWSERS)}", do="apt-get install chromium")
    file = DataRoot(data).run(profile, scene, "report") / "page.html"
    if not file.is_file():
        raise UserError("there is no page to photograph", where=file, do=run_command(file.parent))
    with tempfile.TemporaryDirectory() as folder:
        shot = Path(folder, "page.png")
        options = ["--headless", "--no-sandbox", "--hide-scrollbars", "--window-size=1280,1080", f"--screenshot={shot}"]
        subprocess.run([browser, *options, file.resolve().as_uri()], check=True, capture_output=True)
        picture = cv2.imread(str(shot))
        if picture is None:
            raise UserError("the browser took no picture", where=file)
        cv2.imwrite(str(out), picture, [cv2.IMWRITE_JPEG_QUALITY, 88])
    print(out)


if __name__ == "__main__":
    app()
