"""`python -m groundwalk.export`: ground truth in the layout of another tool or data set."""

from groundwalk.export.command import export
from groundwalk.store.cli import new_app

app = new_app("Ground truth in the layouts of other tools and data sets.")
app.command()(export)

if __name__ == "__main__":
    app()
