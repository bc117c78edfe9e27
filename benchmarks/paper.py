"""The paper's tables and figures of all six scenes, simulated: `python -m benchmarks.paper` after `make paper`.

Writes docs/results/paper-<profile>/ from the finished report of the group `paper`: Tables I to III with the published
numbers beside ours, both figures of each scene, and how long each stage took.
"""

import shutil
from pathlib import Path
from typing import Annotated

import typer

from benchmarks.results import circumstances_of, markdown_table, write_page
from groundwalk.store import DataRoot, UserError
from groundwalk.store.cli import new_app
from groundwalk.store.hints import run_command
from groundwalk.store.manifests import MANIFEST, load_manifest
from groundwalk.store.settings import STAGES

GROUP = "paper"
_FIGURES = ("vio-drift", "error-distribution")
_HEAD = """# The paper's tables of six simulated scenes, profile `{profile}`

Written by `python -m benchmarks.paper` after `make paper profile={profile}`. The places have the names, extents and
shares of images of the paper's and are **simulated**: our numbers say nothing about the real ones. Published figures
stand in lines of their own. What is smaller than in the paper is said below each table. One seed."""

app = new_app(__doc__ or "")


@app.command()
def main(
    data: Annotated[Path, typer.Option(help="The data folder.")] = Path("data"),
    profile: Annotated[str, typer.Option(help="The profile of the finished runs.")] = "demo",
    out: Annotated[Path, typer.Option(help="Folder of the results.")] = Path("docs/results"),
) -> None:
    """Write the page, its tables and its figures."""
    root = DataRoot(data)
    report = root.run(profile, GROUP, "report")
    if not (report / MANIFEST).is_file():
        raise UserError("there is no report of all six scenes", where=report, do=run_command(report))
    group = root.scene(GROUP)[0]
    scenes = root.leaves(group)
    manifests = {
        (scene, stage): load_manifest(folder)
        for scene in (*scenes, *group.members)
        for stage in STAGES
        if ((folder := root.run(profile, scene, stage)) / MANIFEST).is_file()
    }
    stages = [stage for stage in STAGES if any(of == stage for _, of in manifests)]
    minutes = [["scene", *stages]]
    for scene in (*scenes, *group.members):
        took = [manifests[scene, stage]["total_seconds"] if (scene, stage) in manifests else None for stage in stages]
        minutes.append([scene, *("" if seconds is None else f"{seconds / 60:.1f}" for seconds in took)])
    folder = out / f"{GROUP}-{profile}"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    pictures = [f"{scene}-{figure}.png" for figure in _FIGURES for scene in scenes]
    for picture in pictures:
        shutil.copyfile(report / "figures" / picture, folder / picture)
    revisions = (str(one["git_revision"]) for one in manifests.values())
    sections = [
        _HEAD.format(profile=profile),
        circumstances_of(revisions, (one["finished"][:10] for one in manifests.values())),
        *((report / "tables" / f"table{number}.md").read_text(encoding="utf-8").strip() for number in (1, 2, 3)),
        "### Figures\n\nVIO's drift over distance, and how many test frames lie within an error.",
        *(f"![{picture.removesuffix('.png')}]({picture})" for picture in pictures),
        "### Minutes",
        "Of each stage on the clock, two cores without a GPU; beside other jobs, where some ran.",
        markdown_table(minutes),
    ]
    write_page(folder, "README", sections)


if __name__ == "__main__":
    app()
