"""Physics on the host's cores: C MuJoCo called from inside a compiled JAX program."""
