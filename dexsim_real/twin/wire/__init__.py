"""The emulated hand's end of the wire."""
