"""The JAX backend: rigid bodies by MJX, contacts in closed form, our solver."""
