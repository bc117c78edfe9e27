"""Command line of the train stage, and `export` for phones."""

from pathlib import Path
from typing import Annotated

import typer

from groundwalk.artefacts import DataRoot
from groundwalk.artefacts.cli import DataOption, ProfileOption, SceneOption, stage_app
from groundwalk.artefacts.manifests import load_verified
from groundwalk.training.export import export_onnx
from groundwalk.training.stage import STAGE

app = stage_app(STAGE)


@app.command()
def export(
    scene: SceneOption,
    out: Annotated[Path, typer.Option(help="The ONNX file to write.")],
    model: Annotated[str, typer.Option(help="The regressor's id, as in the stage's table `models`.")],
    profile: ProfileOption = "demo",
    data: DataOption = Path("data"),
) -> None:
    """Write a trained model as ONNX: an RGB image in 0..1 to position and quaternion of map_T_cam."""
    folder = DataRoot(data).run(profile, scene, "train")
    load_verified(folder)
    trained = export_onnx(folder / "weights" / f"{model}.pt", out)
    camera = "as captured"
    if trained.focal_px is not None:
        camera = f"of a pinhole with a focal length of {trained.focal_px:.2f} px and its principal point in the middle"
    typer.echo(
        f"{model} of {scene} → {out}; it takes the middle {trained.crop} x {trained.crop} px of images {camera}, "
        f"{trained.resize} px on the shorter side"
    )


if __name__ == "__main__":
    app()
