"""Self-test of the domain randomisation."""
