"""`python -m groundwalk.reports`."""

from groundwalk.reports.definition import STAGE
from groundwalk.store.cli import stage_app

app = stage_app(STAGE)

if __name__ == "__main__":
    app()
