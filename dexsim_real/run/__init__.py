"""`python -m dexsim_real.run`: a policy on the hand."""
