"""Made-up scenes, as a fixture."""

from tests.reports.made_up_scenes import make_run  # noqa: F401
