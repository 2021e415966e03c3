"""`python -m dexsim_real.calibrate`: press, fit, identify."""
