"""`python -m groundwalk`: the same as the command `groundwalk`."""

from groundwalk.cli import app

if __name__ == "__main__":
    app(prog_name="groundwalk")
