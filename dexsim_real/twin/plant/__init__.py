"""The emulated hand's physics, which shares no code with the simulation."""
