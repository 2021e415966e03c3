"""`python -m dexsim.view`: a live view in the browser, of a simulation, of a log or of the emulated hand."""
