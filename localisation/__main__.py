"""Command line of the localise stage, and `locate` for new images."""

from groundwalk.artefacts.cli import stage_app
from groundwalk.localisation.locate import locate
from groundwalk.localisation.stage import STAGE

app = stage_app(STAGE)
app.command("locate")(locate)

if __name__ == "__main__":
    app()
