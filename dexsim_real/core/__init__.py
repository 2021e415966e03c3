"""Foundations of the bridge: errors, run logs, deadlines, thread priorities and signals."""
