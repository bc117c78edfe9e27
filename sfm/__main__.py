"""`python -m sfm --help`."""

from artefacts.cli import stage_app
from sfm.stage import STAGE

app = stage_app(STAGE)

if __name__ == "__main__":
    app()
