"""Physics of the emulated hand, which shares no code with the simulation that policies train in."""
