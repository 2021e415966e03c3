"""Rotate: turn an object in the hand, again and again."""
