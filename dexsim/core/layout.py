"""The layout of an observation vector."""

from collections.abc import Iterable
from typing import NamedTuple


class LayoutEntry(NamedTuple):
    """One named slice of an observation vector."""

    name: str
    size: int
    scale: float | None = None
    """A fixed divisor in the entry's own unit; None asks for running statistics."""


def layout_size(layout: Iterable[LayoutEntry]) -> int:
    """Length of the observation vector that these entries make up."""
    return sum(entry.size for entry in layout)
