"""A textured room, as a fixture."""

from tests.sfm.textured_room import room  # noqa: F401
