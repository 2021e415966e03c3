"""The environment: rooms composed into pure `reset` and `step` functions."""
