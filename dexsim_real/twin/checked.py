"""A user's plant behind its own interface: what it raises, or returns wrongly, becomes one line that says which."""

import json
from typing import Any

import numpy as np

from dexsim.core.cli import plain
from dexsim_real.core.errors import HandError
from dexsim_real.twin.plant.protocol import MotorCommands, Plant, PlantMeasurement
from dexsim_real.twin.plant.shapes import ObjectShape
from dexsim_real.wire import frames

_FIELDS: dict[str, tuple[int, ...]] = {
    "time": (),
    **dict.fromkeys(("joint_position", "joint_velocity", "current", "temperature"), (frames.JOINTS,)),
    "taxel_force": (frames.TIPS, frames.TAXELS, 3),
    "object_quat": (4,),
    "object_position": (3,),
    "object_acceleration": (3,),
}
_DIRECTIONS = ("up", "object_quat")  # that must have a length


class CheckedPlant:
    """A `Plant` that passes everything on to a user's.

    Args:
      plant: the user's.
      given: the option that names its function, for errors.

    Raises:
      HandError: it is no `Plant`; and from every member, when the user's fails or returns what no plant does.
    """

    def __init__(self, plant: Any, given: str):
        self._plant, self._given = plant, given
        lacking = [name for name in vars(Plant) if not name.startswith("_") and not hasattr(plant, name)]
        if lacking:
            raise HandError(f"{given}: it returned {type(plant).__name__} without {lacking[0]!r}; expected a `Plant`")

    @property
    def trial(self) -> int:
        """See `Plant`."""
        return int(self._array("trial", self._ask("trial"), ()))

    @property
    def shape(self) -> ObjectShape:
        """See `Plant`."""
        shape = self._ask("shape")
        if not isinstance(shape, ObjectShape):
            raise HandError(f"{self._given}: its shape is {shape!r:.80}; expected an `ObjectShape`")
        return shape

    @property
    def up(self) -> np.ndarray:
        """See `Plant`."""
        return self._array("up", self._ask("up"), (3,))

    def drive(self, motors: MotorCommands) -> None:
        """See `Plant`."""
        self._ask("drive", motors)

    def advance(self, seconds: float) -> None:
        """See `Plant`."""
        self._ask("advance", seconds)

    def measure(self) -> PlantMeasurement:
        """See `Plant`."""
        found = self._ask("measure")
        fields = {name: self._array(name, getattr(found, name, None), shape) for name, shape in _FIELDS.items()}
        return PlantMeasurement(time=float(fields.pop("time")), **fields)

    def measure_object(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """See `Plant`."""
        found = self._ask("measure_object")
        names = ("object_position", "object_quat", "object_acceleration")
        if not isinstance(found, tuple | list) or len(found) != len(names):
            raise HandError(f"{self._given}: measure_object() returned {found!r:.80}; expected three arrays")
        position, quat, acceleration = (
            self._array(name, value, _FIELDS[name]) for name, value in zip(names, found, strict=True)
        )
        return position, quat, acceleration

    def warm(self, joint: int, degrees: float) -> None:
        """See `Plant`."""
        self._ask("warm", joint, degrees)

    def results(self) -> list[dict[str, Any]]:
        """See `Plant`."""
        found = self._ask("results")
        try:
            sound = all(isinstance(trial, dict) for trial in found) and bool(json.dumps(plain(found)))
        except (TypeError, ValueError):
            sound = False
        if not sound:
            raise HandError(
                f"{self._given}: results() returned {found!r:.80}; expected a list of dicts as JSON has them"
            )
        return list(found)

    def _ask(self, name: str, *arguments: Any) -> Any:
        """An attribute of the plant, or what the method of this name returns."""
        try:
            found = getattr(self._plant, name)
            return found(*arguments) if callable(vars(Plant).get(name)) else found
        except Exception as error:  # Whatever the user's code raises.
            says = " ".join(str(error).split())
            raise HandError(f"{self._given}: {name} fails: {type(error).__name__}: {says:.200}") from error

    def _array(self, name: str, value: Any, shape: tuple[int, ...]) -> np.ndarray:
        try:
            array = np.asarray(value, float)
        except (TypeError, ValueError):
            raise HandError(f"{self._given}: {name} is {value!r:.80}; expected numbers") from None
        if array.shape != shape:
            raise HandError(f"{self._given}: {name} has the shape {array.shape}; expected {shape}")
        if not np.isfinite(array).all():
            raise HandError(f"{self._given}: {name} has numbers that are not finite")
        if name in _DIRECTIONS and not array.any():
            raise HandError(f"{self._given}: {name} has no length")
        return array
