"""`python -m groundwalk.alignment`: the align stage, its check on simulated scenes, and export."""

from groundwalk.alignment.check_truth import check_truth
from groundwalk.alignment.export.command import export
from groundwalk.alignment.stage import STAGE
from groundwalk.artefacts.cli import stage_app

app = stage_app(STAGE)
app.command("check-truth")(check_truth)
app.command("export")(export)

if __name__ == "__main__":
    app()
