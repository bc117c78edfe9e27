"""Plug-ins with one fault each, which groundwalk has to name."""
