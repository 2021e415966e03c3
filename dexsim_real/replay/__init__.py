"""`python -m dexsim_real.replay`: recompute and plot the log of a run."""
