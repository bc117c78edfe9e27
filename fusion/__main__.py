"""Command line of the fuse stage, and `evaluate` for tables from anywhere."""

from groundwalk.fusion.commands import evaluate
from groundwalk.fusion.definition import STAGE
from groundwalk.store.cli import stage_app

app = stage_app(STAGE)
app.command()(evaluate)

if __name__ == "__main__":
    app()
