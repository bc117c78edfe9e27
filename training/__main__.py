"""Command line of the train stage."""

from groundwalk.store.cli import stage_app
from groundwalk.training.definition import STAGE

app = stage_app(STAGE)

if __name__ == "__main__":
    app()
