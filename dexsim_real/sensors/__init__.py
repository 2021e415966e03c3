"""Sensors of the real hand and the object: from bytes and pictures to `Readings`."""
