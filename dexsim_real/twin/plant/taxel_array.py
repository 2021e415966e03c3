"""The taxels of the emulated fingertips: 5 x 120 forces from the solver's contacts.

The taxels are covered by rubber, which reaches some way beyond the lattice and is squeezed where the object's surface
is nearer than that. The rubber's pressure grows as its remaining thickness shrinks and distributes the load over the
taxels. The total load is the normal force of the solver's contacts, as a scale under the fingertip would measure.
Contacts beside the lattice (at the nail) load no taxel. Shear is distributed in the same proportion, along the taxels'
own axes. Imperfections follow: crosstalk, gains, zero errors that wander as the
fingertips warm up, noise, a threshold.
"""

import numpy as np

from dexsim.hand.kinematics import Hand
from dexsim_real.twin.plant.parameters import TrialParameters
from dexsim_real.twin.plant.shapes import ObjectShape

_FULLY, _NOT_AT_ALL = 0.004, 0.008  # m along the skin from a contact to the nearest taxel: fully felt, not felt
_WARMING = 600.0  # s, time constant with which the zeros wander
_LEFT = 0.15  # smallest remaining share of the rubber's thickness


class EmulatedTaxels:
    """The taxels of all fingertips; F fingers, N taxels each."""

    def __init__(self, hand: Hand):
        self._place, self._area = hand.taxel_position.astype(float), hand.taxel_area.astype(float)
        self._normal, self._grid = hand.taxel_normal.astype(float), hand.taxel_grid
        self._axes = _axes(self._place, hand.taxel_normal.astype(float), hand.taxel_grid)

    def configure(self, parameters: TrialParameters, rng: np.random.Generator) -> None:
        """Set the parameters of a trial, and sample the imperfections of the taxels."""
        shape = self._area.shape
        self.thickness, self._beyond = float(parameters.skin_thickness), float(parameters.rubber)
        self._gain = parameters.taxel_gain[:, None] * np.maximum(
            1 + parameters.taxel_spread * rng.standard_normal(shape), 0.1
        )
        self._bias = parameters.taxel_bias * rng.standard_normal(shape)
        self._noise, self._threshold = float(parameters.taxel_noise), float(parameters.taxel_threshold)
        self._crosstalk = float(parameters.taxel_crosstalk)
        self._drift = parameters.taxel_drift * rng.standard_normal(shape)

    def load(
        self,
        shape: ObjectShape,
        place: np.ndarray,
        turn: np.ndarray,
        tips: tuple[np.ndarray, np.ndarray],
        contacts: list[tuple[int, np.ndarray, np.ndarray, np.ndarray]],
    ) -> np.ndarray:
        """Forces [F, N, 3] N on the taxels along their own axes, without imperfections.

        Args:
          shape: of the object.
          place: [3] m, position of the object.
          turn: [3, 3] rotation of the object.
          tips: positions [F, 3] and rotations [F, 3, 3] of the fingertips' frames.
          contacts: for each contact of object and fingertip: finger, point [3] m, normal force [3] N, tangential
            force [3] N on the finger.
        """
        force = np.zeros((*self._area.shape, 3))
        for finger in {contact[0] for contact in contacts}:
            origin, frame = tips[0][finger], tips[1][finger]
            taxels, outward = origin + self._place[finger] @ frame.T, self._normal[finger] @ frame.T
            pressed, dragged = 0.0, np.zeros(3)
            for _, point, normal, tangent in (c for c in contacts if c[0] == finger):
                gap = self._gap(point - taxels, outward)
                weight = np.clip((_NOT_AT_ALL - gap) / (_NOT_AT_ALL - _FULLY), 0.0, 1.0)
                pressed += weight * float(np.linalg.norm(normal))
                dragged += weight * tangent
            share = self._share(shape, (taxels - place) @ turn, self._area[finger])
            axes = np.einsum("ij,nkj->nki", frame, self._axes[finger])
            force[finger] = share[:, None] * (axes @ dragged)
            force[finger, :, 2] = share * pressed
        return force

    def report(self, force: np.ndarray, rng: np.random.Generator, seconds: float) -> np.ndarray:
        """Add the imperfections to forces [F, N, 3] N, this long after the hand was switched on."""
        mixed = force + self._crosstalk / 4 * _spill(force, self._grid)
        reading = mixed * self._gain[..., None] + self._noise * rng.standard_normal(force.shape)
        reading[..., 2] += self._bias + (1 - np.exp(-seconds / _WARMING)) * self._drift
        return np.where(np.abs(reading) < self._threshold, 0.0, reading)

    def _gap(self, away: np.ndarray, outward: np.ndarray) -> float:
        """Distance m along the skin from a contact to the nearest taxel, given the vectors [N, 3] from all taxels.

        Height above a taxel counts only beyond the rubber's thickness.
        """
        height = (away * outward).sum(-1)
        along = ((away - height[:, None] * outward) ** 2).sum(-1)
        return float(np.sqrt((along + np.maximum(np.abs(height) - self.thickness, 0.0) ** 2).min()))

    def _share(self, shape: ObjectShape, points: np.ndarray, area: np.ndarray) -> np.ndarray:
        """Share [N] of the load on each taxel; zero when the object touches no taxel's rubber."""
        squeeze = np.clip((self._beyond - shape.distance(points)) / self.thickness, 0.0, 1 - _LEFT)
        push = squeeze / (1.0 - squeeze) * area
        total = push.sum()
        return push / total if total > 0 else push


def _axes(place: np.ndarray, normal: np.ndarray, grid: tuple[int, int]) -> np.ndarray:
    """Unit vectors [F, N, 3, 3] in the tip's frame: x across the finger, y along it to the tip, z into it."""
    lattice = place.reshape(len(place), *grid, 3)
    along = np.gradient(lattice, axis=2).reshape(place.shape)
    along -= (along * normal).sum(-1, keepdims=True) * normal
    along /= np.linalg.norm(along, axis=-1, keepdims=True)
    return np.stack([np.cross(along, -normal), along, -normal], 2)


def _spill(force: np.ndarray, grid: tuple[int, int]) -> np.ndarray:
    """Sum over the four neighbours on the lattice of their force minus the taxel's force [F, N, 3]."""
    field = force.reshape(len(force), *grid, 3)
    out = np.zeros_like(field)
    for axis in (1, 2):
        step = np.diff(field, axis=axis)
        first = tuple(slice(None, -1) if a == axis else slice(None) for a in range(4))
        last = tuple(slice(1, None) if a == axis else slice(None) for a in range(4))
        out[first] += step
        out[last] -= step
    return out.reshape(force.shape)
