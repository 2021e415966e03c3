"""`python -m dexsim_real.twin`: an emulated hand with the wire format of the real one and physics of its own."""
