"""Command line of the localise stage."""

from groundwalk.artefacts.cli import stage_app
from groundwalk.localisation.stage import STAGE

app = stage_app(STAGE)

if __name__ == "__main__":
    app()
