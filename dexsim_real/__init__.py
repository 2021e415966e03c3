"""The bridge to a real hand: frames, driver, readings, safety, log and replay, control loop.

`python -m dexsim_real.run` runs a policy on a hand; docs/hardware.md explains the parts. Needs
neither a GPU nor MJX, and pyserial only where a port is opened.
"""
