"""One joint's drive: torque, dead-band, friction, latency."""
