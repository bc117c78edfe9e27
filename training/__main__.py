"""Command line of the train stage, and `export` for phones."""

from pathlib import Path
from typing import Annotated

import typer

from artefacts import DataRoot
from artefacts.cli import DataOption, ProfileOption, SceneOption, stage_app
from artefacts.manifests import load_verified
from training.export import export_onnx
from training.stage import STAGE

app = stage_app(STAGE)


@app.command()
def export(
    scene: SceneOption,
    out: Annotated[Path, typer.Option(help="The ONNX file to write.")],
    model: Annotated[str, typer.Option(help="PN or MS-T.")] = "PN",
    profile: ProfileOption = "demo",
    data: DataOption = Path("data"),
) -> None:
    """Write a trained model as ONNX: an RGB image in 0..1 to position and quaternion of map_T_cam."""
    folder = DataRoot(data).run(profile, scene, "train")
    load_verified(folder)
    export_onnx(folder / "weights" / f"{model}.pt", out)
    typer.echo(f"{model} of {scene} → {out}")


if __name__ == "__main__":
    app()
