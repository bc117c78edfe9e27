"""The synthetic walks, as fixtures."""

from synthetic_walks import data, data_of_module, walks  # noqa: F401
