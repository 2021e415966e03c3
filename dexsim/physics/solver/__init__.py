"""Contacts in closed form and a Newton solver in JAX, for `dexsim.physics.jax_backend`."""
