"""python -m alignment"""

from alignment.check_truth import check_truth
from alignment.export.command import export
from alignment.stage import STAGE
from artefacts.cli import stage_app

app = stage_app(STAGE)
app.command("check-truth")(check_truth)
app.command("export")(export)

if __name__ == "__main__":
    app()
