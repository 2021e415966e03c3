"""`python -m dexsim_real.replay`: a run's log, recomputed and shown."""
