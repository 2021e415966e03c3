"""Grasp: catch a falling object and hold it at a commanded force."""
