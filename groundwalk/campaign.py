"""Many scenes, on this machine or a cluster: a Snakemake workflow of their stages, and what became of each.

The workflow is written from what stages declare that they need (`groundwalk.store.definition`), so that a campaign and
`groundwalk run` go by the same steps. Snakemake starts the jobs, again with more memory and time where one fails for
want of it; the stages themselves know whether they have anything to do, and go on from their checkpoints.
"""

import importlib.util
import json
import os
import shlex
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import pandas as pd
import typer

from groundwalk.bucket import download, is_address, upload
from groundwalk.cli import all_commands, stage_of
from groundwalk.pipeline import Step, check, is_step_up_to_date, steps
from groundwalk.store import progress
from groundwalk.store.__main__ import link_folder
from groundwalk.store.cli import EXPECTED_VERSION, DataOption, ProfileOption, new_app, version_of
from groundwalk.store.cores import usable_cores
from groundwalk.store.errors import UserError
from groundwalk.store.files import read_json, write_json, written_aside
from groundwalk.store.locks import locked
from groundwalk.store.manifests import MANIFEST, listed_files
from groundwalk.store.runs import finished_stages
from groundwalk.store.settings import STAGES, DataRoot, checked_name
from groundwalk.store.tables import refuse_unnamed_fields

app = new_app("Many scenes.")
PLAN, WORKFLOW, TABLE, PAGE = "plan.json", "Snakefile", "campaign.parquet", "campaign.html"
_COLUMNS = ("scene", "captures", "profile", "until")
_ATTEMPTS = 3  # each with so many times the memory and time of the first
# Where no finished run says what a stage takes; of one that does, so many times as much.
_DEFAULT_MIB, _DEFAULT_MINUTES, _MARGIN = 4096, 60, 1.5
_MEMORY_SHARE = 0.9  # of this machine's, for jobs that run here
# Another node, or more memory, may do: words of errors that a stage ends with as it does with refusals.
_MACHINES = (
    "no space left|quota exceeded|memory is used up|allocate memory|died .SIGKILL|input/output error"
    "|stale file handle|another version of groundwalk"
)
_SEVERAL_CORES = {"sfm", "localise", "train"}
_MAX_CORES = 8


class State(StrEnum):
    """What became of a stage of a scene; those that need a person come first."""

    REFUSED = "refused"
    FAILED = "failed"
    RUNNING = "running"
    WAITING = "waiting"
    DONE = "done"


@dataclass(frozen=True)
class Job:
    """A stage of a scene, or `simulate`, and the ids of the jobs that must be done before."""

    scene: str
    profile: str
    command: str
    needs: list[str] = field(default_factory=list)

    @property
    def id(self) -> str:
        """profile/scene/command: its flag below done/, and its log below logs/."""
        return f"{self.profile}/{self.scene}/{self.command}"


@app.command(context_settings={"allow_extra_args": True, "ignore_unknown_options": True})
def campaign(
    context: typer.Context,
    table: Annotated[Path, typer.Argument(help="CSV: scene, and, where wanted, captures, profile, until.")],
    profile: ProfileOption = "demo",
    cores: Annotated[int | None, typer.Option(help="Cores to use of this machine; all unless named.", min=1)] = None,
    status: Annotated[bool, typer.Option("--status", help="Only say what became of each scene so far.")] = False,
    results: Annotated[
        str, typer.Option(help="In the end send finished stages and the page there, too, as s3://bucket/folder.")
    ] = "",
    data: DataOption = Path("data"),
) -> None:
    """Run many scenes as a Snakemake workflow; what follows `--` is Snakemake's, as `-- --executor slurm --jobs 50`.

    A scene that fails stops no other one. The same command again does what is left. The workflow, logs, a table of all
    stages (campaign.parquet) and a page sorted by what needs a person are in data/campaigns/<name of the CSV>.
    """
    from groundwalk.reports.runs_index import write_index

    root = DataRoot(data)
    folder = root.root / "campaigns" / checked_name("scene", table.stem)
    _refuse_another(folder, table)
    if not status:
        with locked(folder):
            jobs, problems = plan(table, profile, root)
            cores = cores or usable_cores()
            write_workflow(folder, jobs, problems, root, cores, table=table, is_local=_is_local(context.args))
            failed = _snakemake(folder, cores, context.args) if jobs else 0
    outcome = write_report(folder, root)
    write_index(root)
    progress.stdout.print(f"{_counts(outcome)}: {folder / PAGE}")
    if results:
        upload(root.root, _results(folder, outcome, root), results)
    if not status and (failed or (outcome["state"] != State.DONE).any()):
        raise typer.Exit(1)


def _refuse_another(folder: Path, table: Path) -> None:
    """UserError where a campaign's folder is that of another CSV of the same name, which is still there."""
    planned = Path(read_json(folder / PLAN).get("table") or table)
    if planned.exists() and table.exists() and not table.samefile(planned):
        raise UserError(
            "the campaign's folder is of another table with the same name",
            where=folder,
            expected=f"a campaign of {table.absolute()}",
            found=f"one of {planned}",
            do="give the table another name, or name another data folder with --data",
        )


def plan(table: Path, profile: str, data: DataRoot) -> tuple[list[Job], dict[str, str]]:
    """The jobs of all scenes of a CSV, whose captures are linked or, from a bucket, downloaded first; and the messages
    of scenes that can't run. UserError for a table that isn't one."""
    jobs: dict[str, Job] = {}
    problems: dict[str, str] = {}
    seen: set[str] = set()
    captures_of: dict[str, str] = {}
    for number, row in enumerate(read_scenes(table), start=2):
        scene = row["scene"]
        of_scene = f"{row.get('profile', profile)}/{scene}"
        if of_scene in seen:
            problems[f"{of_scene} (line {number})"] = f"the scene stands twice in {table.name}"
            continue
        seen.add(of_scene)
        captures = row.get("captures", "")
        if captures_of.setdefault(scene, captures) != captures:
            problems[of_scene] = f"the scene has other captures above, {captures_of[scene]}: give it another name"
            continue
        try:
            if captures:
                local = captures_folder(table, row, data)
                if is_address(captures):
                    local.mkdir(parents=True, exist_ok=True)
                link_folder(data, scene, local)
                if is_address(captures):
                    with locked(local):
                        download(captures, local)
            jobs |= {job.id: job for job in _jobs_of(data, row.get("profile", profile), scene, row.get("until"))}
        except UserError as error:
            problems[of_scene] = str(error)
    return list(jobs.values()), problems


def captures_folder(table: Path, row: dict[str, str], data: DataRoot) -> Path:
    """The folder that a line of a CSV has as its scene's captures, or downloads them into."""
    if is_address(row["captures"]):
        return data.root / "downloads" / checked_name("scene", row["scene"])
    # Path.expanduser fails where there is no such user.
    return table.parent / os.path.expanduser(row["captures"])  # noqa: PTH111


def read_scenes(table: Path) -> Iterator[dict[str, str]]:
    """The lines of a CSV of scenes: `scene`, and what else is filled in. UserError for a table that isn't one."""
    if not table.is_file():
        raise UserError("there is no such table of scenes", where=table, expected=f"a CSV of {', '.join(_COLUMNS)}")
    try:
        # A scene may be called None, or NA.
        content = pd.read_csv(
            table, dtype=str, encoding="utf-8-sig", skipinitialspace=True, keep_default_na=False
        ).fillna("")
        refuse_unnamed_fields(content, table)
    except (ValueError, UnicodeError) as error:
        raise UserError("a table of scenes can't be read", where=table, found=error, expected="CSV, UTF-8") from None
    if "scene" not in content or not set(content) <= set(_COLUMNS):
        found = ", ".join(map(str, content))
        raise UserError("a table of scenes has other columns", where=table, found=found, expected=", ".join(_COLUMNS))
    if content.empty:
        raise UserError("a table of scenes lists no scene", where=table, expected="a line for each scene")
    for row in content.to_dict("records"):
        yield {str(name): value.strip() for name, value in row.items() if value.strip() or name == "scene"}


def _jobs_of(data: DataRoot, profile: str, scene: str, until: str | None) -> Iterator[Job]:
    """The jobs of a scene, each with those whose results it reads: of its scene and, in a group, of the group's."""
    made = steps(data, profile, scene, until or STAGES[-1])
    for step in made:
        check(step, Step("simulate", step.scene) in made, profile, data)
    for step in made:
        job = Job(step.scene, profile, step.command)
        if step.command != "simulate":
            stage, scenes = stage_of(step.command), {step.scene, *data.leaves(data.scene(step.scene)[0])}
            read = {*stage.needs, *stage.wants, *(["simulate"] if stage.reads_captures else [])}
            before = (other for other in made if other.command in read and other.scene in scenes)
            job.needs.extend(Job(other.scene, profile, other.command).id for other in before)
        yield job


def write_workflow(
    folder: Path,
    jobs: list[Job],
    problems: dict[str, str],
    data: DataRoot,
    cores: int = 1,
    *,
    table: Path | None = None,
    is_local: bool = True,
) -> None:
    """Write the plan, which names the CSV `table`, and the workflow. Flags of what isn't up to date any more go, and so
    do notes of refusals: their reason may be gone. A job takes all cores of this machine, or its share of them where
    the jobs run here: side by side scenes keep cores busier than one after the other."""
    for job in jobs:
        flag = folder / "done" / job.id
        if flag.exists() and not is_step_up_to_date(Step(job.command, job.scene), job.profile, data):
            flag.unlink()
        _refusal(folder, job).unlink(missing_ok=True)
    commands = list(dict.fromkeys(job.command for job in jobs))
    kinds = Counter((job.profile, job.command) for job in jobs)
    content = {
        "table": table and str(table.resolve()),
        "needs": {job.id: job.needs for job in jobs},
        "resources": {
            "/".join(kind): _resources(*kind, data, max(1, cores // scenes) if is_local else cores)
            for kind, scenes in kinds.items()
        },
        "problems": problems,
    }
    folder.mkdir(parents=True, exist_ok=True)
    write_json(folder / PLAN, content)
    rules = [_RULE.format(command=c, retries=_ATTEMPTS - 1, run=_shell(c, data)) for c in commands]
    with written_aside(folder / WORKFLOW) as partial:
        partial.write_text(_HEAD.format(plan=PLAN, folder=str(folder)) + "".join(rules), encoding="utf-8")


_HEAD = """# Written by `groundwalk campaign`, not to be edited. Where its folder has this path it runs by itself, too:
#     snakemake --cores 2 --keep-going
import json
from pathlib import Path

FOLDER = Path({folder!r})
PLAN = json.loads((FOLDER / "{plan}").read_text())
needs = lambda command: lambda w: [f"done/{{n}}" for n in PLAN["needs"][f"{{w.profile}}/{{w.scene}}/{{command}}"]]
kind = lambda w, command: PLAN["resources"][f"{{w.profile}}/{{command}}"]
take = lambda command, what: lambda w, attempt: attempt * kind(w, command)[what]

localrules: all
wildcard_constraints: profile="[^/]+", scene="[^/]+"

rule all:
    input: [f"done/{{job}}" for job in PLAN["needs"]]
"""
_RULE = """
rule stage_{command}:
    input: needs("{command}")
    output: touch("done/{{profile}}/{{scene}}/{command}")
    params: log=lambda w: f"{{FOLDER}}/logs/{{w.profile}}/{{w.scene}}/{command}.log"
    threads: lambda w: kind(w, "{command}")["threads"]
    resources: mem_mb=take("{command}", "mem_mb"), runtime=take("{command}", "runtime")
    retries: {retries}
    shell: {run}
"""


def _shell(command: str, data: DataRoot) -> str:
    """What a job does, as text of the workflow. What a stage refuses it refuses each time: it isn't tried again, and
    the report says so; but for what the machine lacks, which another one may have. The log is no `log` of Snakemake's,
    which removes these before another attempt. Packages' own commands leave the page of all runs alone, which the
    campaign writes once. A worker with another version of groundwalk says so."""
    python = f"OMP_NUM_THREADS={{threads}} {shlex.quote(sys.executable)} -P -m"
    packages = {one.name: f"groundwalk.{one.module.rpartition('.')[0]}" for one in all_commands()}
    options = f"--scene {{wildcards.scene:q}} --profile {{wildcards.profile:q}} --data {shlex.quote(str(data.root))}"
    version = "" if command == "simulate" else f"{EXPECTED_VERSION}={shlex.quote(version_of(stage_of(command)))} "
    run = f'{version}{python} {packages[command]} {options} > "$log" 2>&1'
    report = f' {python} {packages["report"]} --force {options} > "$log.report" 2>&1 || true;'
    after = "" if command in ("simulate", "import", "report") else report
    return repr(
        f'log={{params.log:q}}; [ ! -e "$log.refused" ] || exit 2; mkdir -p "$(dirname "$log")"; status=0; '
        f"{run} || status=$?; if [ $status = 2 ] && ! grep -qiE '{_MACHINES}' \"$log\"; then "
        f'touch "$log.refused";{after} fi; exit $status'
    )


def _resources(profile: str, command: str, data: DataRoot, cores: int) -> dict[str, int]:
    """Cores, of these at most, MiB and minutes of a command: by the finished runs of the data folder with this
    profile."""
    made = finished_stages(data, command, profile)
    mib = max((one.mib for one in made), default=0) * _MARGIN
    minutes = max((one.seconds for one in made), default=0) * _MARGIN / 60
    threads = min(cores, _MAX_CORES) if command in _SEVERAL_CORES else 1
    measured = {"mem_mb": round(mib) + 512, "runtime": round(minutes) + 5}
    return {"threads": threads, **(measured if made else {"mem_mb": _DEFAULT_MIB, "runtime": _DEFAULT_MINUTES})}


def _snakemake(folder: Path, cores: int, more: list[str]) -> int:
    if importlib.util.find_spec("snakemake") is None:
        raise UserError(
            "Snakemake, which runs campaigns, isn't installed", do="install groundwalk with its extra: [campaign]"
        )
    command = [sys.executable, "-P", "-m", "snakemake", "--snakefile", folder / WORKFLOW, "--directory", folder]
    if _is_local(more):
        mib = round(_MEMORY_SHARE * os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**20)
        more = ["--resources", f"mem_mb={mib}", *more]
    # The campaign's own lock is held, and what a job left undone the stage continues.
    options = ["--cores", cores, "--keep-going", "--nolock", "--rerun-incomplete", "--rerun-triggers", "mtime"]
    return subprocess.run([*map(str, command + options), "--scheduler", "greedy", "--quiet", "rules", *more]).returncode


def _is_local(more: list[str]) -> bool:
    """Whether Snakemake's options leave the jobs to this machine."""
    elsewhere = ("-e", "--executor", "--profile", "--workflow-profile")
    return "SNAKEMAKE_PROFILE" not in os.environ and not any(one.startswith(elsewhere) for one in more)


def _refusal(folder: Path, job: Job) -> Path:
    return folder / "logs" / f"{job.id}.log.refused"


def write_report(folder: Path, data: DataRoot) -> pd.DataFrame:
    """The campaign's table, a row a scene and stage, written as Parquet and as a page: those that need a person first.
    UserError where the campaign wasn't planned yet."""
    if not (folder / PLAN).is_file():
        raise UserError("there is no such campaign yet", where=folder, do="run it without --status")
    planned = read_json(folder / PLAN)
    rows = []
    for job_id, needs in planned["needs"].items():
        profile, scene, command = job_id.split("/")
        rows.append(_row(folder, Job(scene, profile, command, needs), data))
    for of_scene, message in planned["problems"].items():
        profile, _, scene = of_scene.partition("/")
        rows.append({"scene": scene, "profile": profile, "stage": "", "state": State.REFUSED, "message": message})
    columns = ["scene", "profile", "stage", "state", "seconds", "peak_memory_mib", "figures", "message"]
    rows.sort(key=lambda row: [*State].index(row["state"]))
    table = pd.DataFrame(rows, columns=columns).astype({"seconds": float, "peak_memory_mib": float})
    table = table.assign(message=table["message"].astype(object).fillna(""))
    with written_aside(folder / TABLE) as partial:
        table.assign(state=table["state"].astype(str)).to_parquet(partial, index=False)
    with written_aside(folder / PAGE) as partial:
        partial.write_text(_page(table, folder.name), encoding="utf-8")
    return table


def _row(folder: Path, job: Job, data: DataRoot) -> dict[str, Any]:
    final = data.captures(job.scene) if job.command == "simulate" else data.run(job.profile, job.scene, job.command)
    log = folder / "logs" / f"{job.id}.log"
    text = log.read_text(encoding="utf-8", errors="replace") if log.is_file() else ""
    row: dict[str, Any] = {"scene": job.scene, "profile": job.profile, "stage": job.command}
    if (folder / "done" / job.id).exists():
        made = read_json(final / MANIFEST)
        figures = {"seconds": made.get("total_seconds"), "peak_memory_mib": made.get("peak_memory_mib")}
        return {**row, "state": State.DONE, **figures, "figures": json.dumps(made.get("figures", {}))}
    last_line = text.strip().rpartition("\n")[2]
    try:
        with locked(final):
            pass
    except UserError:
        return {**row, "state": State.RUNNING, "message": last_line}
    if not text:
        return {**row, "state": State.WAITING}
    _, error, message = text.rpartition("error: ")
    state = State.REFUSED if _refusal(folder, job).exists() else State.FAILED
    return {**row, "state": state, "message": message.strip() if error else last_line}


def _results(folder: Path, outcome: pd.DataFrame, data: DataRoot) -> list[str]:
    """The files of a campaign's finished stages, its table and its page, by their paths in the data folder."""
    done = outcome[(outcome["state"] == State.DONE) & (outcome["stage"] != "simulate")]
    stages = [data.run(*names) for names in done[["profile", "scene", "stage"]].to_numpy().tolist()]
    files = [stage / name for stage in stages for name in sorted(listed_files(stage)) if (stage / name).is_file()]
    return [path.relative_to(data.root).as_posix() for path in (*files, folder / TABLE, folder / PAGE)]


def _counts(table: pd.DataFrame) -> str:
    counts = table["state"].value_counts()
    return ", ".join(f"{counts.get(state, 0)} {state}" for state in State)


def _page(table: pd.DataFrame, name: str) -> str:
    # Here, as most commands need no page.
    from groundwalk.reports.grids import EMPTY, html_table, plain_grid
    from groundwalk.reports.templating import plain_page

    shown = table[["scene", "profile", "stage", "state", "message", "seconds", "peak_memory_mib"]]
    rows = (
        [f"{v:,.0f}" if isinstance(v, float) else v for v in row]
        for row in shown.astype(object).where(shown.notna(), EMPTY).itertuples(index=False)
    )
    caption = f"{_counts(table)}; those that need attention come first. The page of all runs links to their reports."
    heads = "scene | profile | stage | state | message | s | MiB"
    return plain_page(name, "campaign", [html_table(plain_grid("stages", "Stages", caption, heads, rows, 5))])
