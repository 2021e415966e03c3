"""Foundations that know nothing of hands: configuration, files, errors, pytrees, compilation, statistics."""
