"""`python -m groundwalk.sfm --help`."""

from groundwalk.artefacts.cli import stage_app
from groundwalk.sfm.stage import STAGE

app = stage_app(STAGE)

if __name__ == "__main__":
    app()
