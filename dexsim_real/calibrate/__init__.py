"""`python -m dexsim_real.calibrate`: calibrate a hand by pressing its fingertips, or identify its drives."""
