"""The synthetic walks, as fixtures."""

from tests.synthetic_walks import data, data_of_module, walks  # noqa: F401
