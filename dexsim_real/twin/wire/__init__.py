"""The emulated hand's end of the wire: firmware, timing, sensors of the object."""
