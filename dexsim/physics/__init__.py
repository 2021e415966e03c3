"""The physics seam: one scene, several backends."""
