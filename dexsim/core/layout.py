"""The layout of an observation vector."""

from collections.abc import Collection, Iterable
from typing import NamedTuple

import numpy as np


class LayoutEntry(NamedTuple):
    """One named slice of an observation vector."""

    name: str
    size: int
    scale: float | None = None
    """A fixed divisor in the entry's own unit; None asks for running statistics."""


def layout_size(layout: Iterable[LayoutEntry]) -> int:
    """Length of the observation vector that these entries make up."""
    return sum(entry.size for entry in layout)


def is_of(layout: Iterable[LayoutEntry], names: Collection[str]) -> np.ndarray:
    """Whether each value of the observation vector [n] is of one of the entries of these names."""
    return np.concatenate([np.full(entry.size, entry.name in names) for entry in layout])
