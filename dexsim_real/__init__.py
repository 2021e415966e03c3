"""The bridge to a real hand: serial frames, driver, safety, log, control loop (not built yet)."""
