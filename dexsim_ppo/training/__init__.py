"""A training run: loop, presets, display and files."""
