"""What one frame of video shows."""

import dataclasses
from collections.abc import Callable
from typing import Any


@dataclasses.dataclass(frozen=True)
class Snapshot:
    """What a picture shows. K primitives (object frame), F fingers of N taxels; stack along T for a video.

    A pytree where `dexsim.env.evaluation` takes it.
    """

    joint_position: Any  # [J] rad
    object_position: Any  # [3] m, palm frame
    object_rotation: Any  # [3, 3]
    primitive_size: Any  # [K, 3] m
    primitive_position: Any  # [K, 3] m
    primitive_rotation: Any  # [K, 3, 3]
    primitive_active: Any  # [K] bool
    taxel_force: Any  # [F, N] N
    command: Any  # any shape
    target_force: Any  # [] N
    finger_force: Any  # [F] N
    goal_rotation: Any = None  # [3, 3] orientation that the object is asked for; None for a task without goals
    turns: Any = None  # [] int32 goals reached since the episode began; None for a task without goals
    seconds: Any = None  # [] s since the episode began; None where nobody counts

    def map(self, change: Callable[[Any], Any]) -> "Snapshot":
        """With every array changed, such as `stacked.map(lambda x: x[0])`."""
        return Snapshot(**{name: None if array is None else change(array) for name, array in vars(self).items()})
