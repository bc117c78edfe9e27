"""`python -m groundwalk.alignment`: the align stage and its check on simulated scenes."""

from groundwalk.alignment.check_truth import check_truth
from groundwalk.alignment.definition import STAGE
from groundwalk.store.cli import stage_app

app = stage_app(STAGE)
app.command("check-truth")(check_truth)

if __name__ == "__main__":
    app()
