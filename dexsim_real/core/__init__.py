"""Foundations of the bridge: errors, the log, timing, the process."""
