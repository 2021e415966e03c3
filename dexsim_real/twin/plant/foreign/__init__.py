"""A hand from a user's MJCF in place of the emulated hand's own physics."""
