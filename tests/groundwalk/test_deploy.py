"""The Snakemake profiles of deploy/, by dry runs of a campaign's workflow, and what its jobs name outside of it."""

import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest

from groundwalk.campaign import WORKFLOW, Job, write_workflow
from groundwalk.store import DataRoot

DEPLOY = Path(__file__).resolve().parents[2] / "deploy"


@pytest.mark.parametrize(
    ("profile", "plugins", "more"),
    [
        ("slurm", ["snakemake_executor_plugin_slurm"], []),
        (
            "kubernetes",
            ["snakemake_executor_plugin_kubernetes", "snakemake_storage_plugin_fs"],
            ["--default-storage-prefix", "{folder}"],
        ),
    ],
)
def test_a_profile_plans_the_jobs_of_a_campaign(
    tmp_path: Path, profile: str, plugins: list[str], more: list[str]
) -> None:
    for name in ("snakemake", *plugins):
        if importlib.util.find_spec(name) is None:
            pytest.skip(f"{name.replace('_', '-')} isn't installed")
    folder = tmp_path / "campaign"
    jobs = [Job("one", "tiny", "import"), Job("one", "tiny", "train", ["tiny/one/import"])]
    write_workflow(folder, jobs, {}, DataRoot(tmp_path / "data"))
    elsewhere = tmp_path / "elsewhere"  # as on a machine that only sees the folder
    elsewhere.mkdir()
    command = [sys.executable, "-m", "snakemake", "--snakefile", folder / WORKFLOW, "--directory", elsewhere]
    options = [
        "--profile",
        DEPLOY / profile,
        *(text.format(folder=folder) for text in more),
        "--dry-run",
        "--printshellcmds",
    ]
    ended = subprocess.run([*map(str, command + options)], capture_output=True, text=True)
    said = ended.stdout + ended.stderr
    assert ended.returncode == 0, said
    assert "stage_train" in said and f"{folder}/logs/tiny/one/train.log" in said and "gpu=1" in said
