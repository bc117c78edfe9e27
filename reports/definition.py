"""The stage report: its version, settings and inputs; what runs it is imported when it is to run."""

from pydantic import Field

from groundwalk.store import Settings
from groundwalk.store.definition import Stage
from groundwalk.store.registry import Lazy


class ReportSettings(Settings):
    published: bool = Field(True, description="print the paper's numbers beside ours where it has the same scene")


STAGE = Stage(
    name="report",
    version=27,
    settings=ReportSettings,
    reads_shipped=("published",),
    needs=("import",),
    wants=("sfm", "align", "localise", "train", "fuse"),
    run=Lazy("groundwalk.reports.stage:run"),
    help="Report: a page of what is finished, from the verdict on the capture to Tables I to IV beside the paper's.",
)
