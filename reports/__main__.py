"""`python -m groundwalk.reports`."""

from groundwalk.artefacts.cli import stage_app
from groundwalk.reports.stage import STAGE

app = stage_app(STAGE)

if __name__ == "__main__":
    app()
