"""The emulated hand's end of the wire: firmware, timing, faults, sensors of the object."""
