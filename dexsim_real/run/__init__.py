"""`python -m dexsim_real.run`: run a policy on the hand."""
