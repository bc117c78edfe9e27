"""A scene with two boards, as fixtures."""

from tests.localisation.board_scene import boards, make_boards  # noqa: F401
