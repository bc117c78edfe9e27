"""`python -m reports`."""

from artefacts.cli import stage_app
from reports.stage import STAGE

app = stage_app(STAGE)

if __name__ == "__main__":
    app()
