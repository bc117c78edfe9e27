"""A textured room, as a fixture."""

from textured_room import room  # noqa: F401
