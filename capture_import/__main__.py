"""`python -m groundwalk.capture_import`: the import stage, and a look at captures without importing."""

from groundwalk.capture_import.commands import add_commands
from groundwalk.capture_import.definition import STAGE
from groundwalk.store.cli import stage_app

app = stage_app(STAGE)
add_commands(app)

if __name__ == "__main__":
    app()
