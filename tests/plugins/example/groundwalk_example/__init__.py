"""One capture format, one regressor, one fusion method and one exporter for groundwalk."""
