"""Taxels of a user's hand: every contact loads the taxels nearest to its point.

Neither the object's surface nor a skin is asked: a contact of the solver has a point and a force. It is felt by the
taxels within a few millimetres, the nearest most.
"""

import numpy as np

from dexsim_real.twin.plant.shapes import ObjectShape
from dexsim_real.twin.plant.taxel_array import EmulatedTaxels

_SPREAD = 0.002  # m, how far the load of a point contact spreads through the rubber
_FULLY, _NOT_AT_ALL = 0.004, 0.008  # m from a contact to the nearest taxel: fully felt, not felt


class ContactTaxels(EmulatedTaxels):
    """Loads from contact points; gains, noise and the other imperfections are those of the emulated hand."""

    def load(
        self,
        shape: ObjectShape,
        place: np.ndarray,
        turn: np.ndarray,
        tips: tuple[np.ndarray, np.ndarray],
        contacts: list[tuple[int, np.ndarray, np.ndarray, np.ndarray]],
    ) -> np.ndarray:
        """See `EmulatedTaxels.load`; the object is not used."""
        force = np.zeros((*self._area.shape, 3))
        for finger, point, normal, tangent in contacts:
            frame = tips[1][finger]
            square = ((self._place[finger] - (point - tips[0][finger]) @ frame) ** 2).sum(-1)
            nearest = float(np.sqrt(square.min()))
            weight = np.clip((_NOT_AT_ALL - nearest) / (_NOT_AT_ALL - _FULLY), 0.0, 1.0)
            share = np.exp(-(square - nearest**2) / (2 * _SPREAD**2))
            share *= weight / share.sum()
            force[finger, :, :2] += share[:, None] * (self._axes[finger][:, :2] @ (frame.T @ tangent))
            force[finger, :, 2] += share * float(np.linalg.norm(normal))
        return force
