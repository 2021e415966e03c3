"""Physics: one scene, one interface, several engines."""
