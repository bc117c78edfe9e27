"""Made-up scenes, as a fixture, and reports without what takes most of their time."""

from tests.reports.made_up_scenes import make_run, no_figures  # noqa: F401
