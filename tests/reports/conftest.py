"""Made-up scenes, as a fixture."""

from made_up_scenes import make_run  # noqa: F401
