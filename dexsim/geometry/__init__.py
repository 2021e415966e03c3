"""Rotations, distances and meshes."""
