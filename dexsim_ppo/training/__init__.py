"""A training run: loop, presets, display, files."""
