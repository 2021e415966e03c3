"""The taxels of the emulated fingertips: 5 x 120 forces from the solver's contacts.

The total load of a fingertip is the normal force of the solver's contacts, as a scale under it would measure. Contacts
beside the lattice (at the nail) load no taxel. On the emulated hand's own fingertips the load is distributed by the
rubber that covers the taxels and reaches some way beyond them: it is squeezed where the object's surface is nearer than
that, and its pressure grows as its remaining thickness shrinks. Of a plant model the skin is not known: there the load
of a contact spreads over the taxels around its point. Shear is distributed in the same proportion, along the taxels'
own axes. Imperfections follow: crosstalk, gains, zero errors that wander as the fingertips warm up, noise, a threshold.
"""

import numpy as np
from scipy import ndimage

from dexsim.hand.description import Hand
from dexsim_real.twin.plant.hand_model import Pose
from dexsim_real.twin.plant.parameters import TrialParameters
from dexsim_real.twin.plant.scene import TipContact
from dexsim_real.twin.plant.shapes import ObjectShape

_FULLY, _NOT_AT_ALL = 0.004, 0.008  # m along the skin from a contact to the nearest taxel: fully felt, not felt
_WARMING = 600.0  # s, time constant with which the zeros wander
_LEFT = 0.15  # smallest remaining share of the rubber's thickness
_SPREAD = 0.002  # m, standard deviation of how far the load of a point contact spreads
_FROM_NEIGHBOURS = np.array([[0.0, 1, 0], [1, -4, 1], [0, 1, 0]])[None, :, :, None]  # on the lattice


class EmulatedTaxels:
    """The taxels of all fingertips; F fingers, N taxels each.

    With `by_point` loads are distributed around the points of the contacts, not by the squeezed rubber.
    """

    def __init__(self, hand: Hand, *, by_point: bool = False):
        self._place, self._area = hand.taxel_position.astype(float), hand.taxel_area.astype(float)
        self._normal, self._grid, self._by_point = hand.taxel_normal.astype(float), hand.taxel_grid, by_point
        # [F, N, 3, 3] unit vectors in the tip's frame: x across the finger, y along it to the tip, z into it.
        along = np.gradient(self._place.reshape(len(self._place), *self._grid, 3), axis=2).reshape(self._place.shape)
        along -= (along * self._normal).sum(-1, keepdims=True) * self._normal
        along /= np.linalg.norm(along, axis=-1, keepdims=True)
        self._axes = np.stack([np.cross(along, -self._normal), along, -self._normal], 2)

    def configure(self, parameters: TrialParameters, rng: np.random.Generator) -> None:
        """Set the parameters of a trial, and sample the imperfections of the taxels."""
        shape = self._area.shape
        self._parameters = parameters
        spread = np.maximum(1 + parameters.taxel_spread * rng.standard_normal(shape), 0.1)
        self._gain = parameters.taxel_gain[:, None] * spread
        self._bias = parameters.taxel_bias * rng.standard_normal(shape)
        self._drift = parameters.taxel_drift * rng.standard_normal(shape)

    def load(
        self, shape: ObjectShape, place: np.ndarray, turn: np.ndarray, tips: Pose, contacts: list[TipContact]
    ) -> np.ndarray:
        """Forces [F, N, 3] N on the taxels along their own axes, without imperfections: of an object at a position
        [3] m and with a rotation [3, 3], fingertips with these frames, and their contacts."""
        force = np.zeros((*self._area.shape, 3))
        for finger in {contact.finger for contact in contacts}:
            origin, frame = tips[0][finger], tips[1][finger]
            taxels, outward = origin + self._place[finger] @ frame.T, self._normal[finger] @ frame.T
            pressed, dragged, near = 0.0, np.zeros(3), np.zeros(len(taxels))
            for contact in (c for c in contacts if c.finger == finger):
                gap = self._gap(contact.point - taxels, outward)
                weight = np.clip((_NOT_AT_ALL - gap) / (_NOT_AT_ALL - _FULLY), 0.0, 1.0)
                normal = weight * float(np.linalg.norm(contact.normal))
                pressed += normal
                dragged += weight * contact.tangent
                square = ((taxels - contact.point) ** 2).sum(-1)
                around = np.exp(-(square - square.min()) / (2 * _SPREAD**2))
                near += normal * (around / around.sum())
            if not self._by_point:  # The pressure of the rubber; its scale is arbitrary.
                depth = self._parameters.rubber - shape.distance((taxels - place) @ turn)
                squeeze = np.clip(depth / self._parameters.skin_thickness, 0.0, 1 - _LEFT)
                near = squeeze / (1.0 - squeeze) * self._area[finger]
            share = near / (near.sum() or 1.0)
            axes = np.einsum("ij,nkj->nki", frame, self._axes[finger])
            force[finger] = share[:, None] * (axes @ dragged)
            force[finger, :, 2] = share * pressed
        return force

    def report(self, force: np.ndarray, rng: np.random.Generator, seconds: float) -> np.ndarray:
        """Add the imperfections to forces [F, N, 3] N, this long after the hand was switched on."""
        parameters = self._parameters
        lattice = force.reshape(len(force), *self._grid, 3)
        spilled = ndimage.convolve(lattice, _FROM_NEIGHBOURS, mode="nearest").reshape(force.shape)
        mixed = force + parameters.taxel_crosstalk / 4 * spilled
        reading = mixed * self._gain[..., None] + parameters.taxel_noise * rng.standard_normal(force.shape)
        reading[..., 2] += self._bias + (1 - np.exp(-seconds / _WARMING)) * self._drift
        return np.where(np.abs(reading) < parameters.taxel_threshold, 0.0, reading)

    def _gap(self, away: np.ndarray, outward: np.ndarray) -> float:
        """Distance m along the skin from a contact to the nearest taxel, given the vectors [N, 3] from all taxels."""
        height = (away * outward).sum(-1)
        along = ((away - height[:, None] * outward) ** 2).sum(-1)
        # Height above a taxel counts only beyond the rubber's thickness.
        beyond = np.maximum(np.abs(height) - self._parameters.skin_thickness, 0.0)
        return float(np.sqrt((along + beyond**2).min()))
