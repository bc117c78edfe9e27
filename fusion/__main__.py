"""Command line of the fuse stage, and `evaluate` and `sweep` for tables from anywhere."""

from groundwalk.fusion.commands import evaluate, sweep
from groundwalk.fusion.definition import STAGE
from groundwalk.store.cli import stage_app

app = stage_app(STAGE)
app.command()(evaluate)
app.command()(sweep)

if __name__ == "__main__":
    app()
