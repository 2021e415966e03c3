"""An emulated hand whose body, motors and contacts are a user's MJCF, in C MuJoCo.

From the file: kinematics, inertias, geoms, friction, stiffness, motors, time step and solver. From the trial's
parameters: object, mount, latency, and the errors of all sensors.
"""

from pathlib import Path
from typing import Any

from dexsim.hand.kinematics import Hand
from dexsim_real.core.errors import HandError
from dexsim_real.twin.plant.assistant import PLACES, Place
from dexsim_real.twin.plant.emulated_hand import EmulatedHand
from dexsim_real.twin.plant.foreign.model import read_model
from dexsim_real.twin.plant.foreign.motors import ForeignMotors
from dexsim_real.twin.plant.foreign.scene import build_foreign_scene, palm_face
from dexsim_real.twin.plant.foreign.taxels import ContactTaxels
from dexsim_real.twin.plant.scene import Scene

_OF_THE_FILE = frozenset(
    "stiffness damping gear_play torque speed efficiency ripple ripple_count coulomb_friction viscous_friction "
    "latency_spread friction link_friction stiffness_contact restitution rubber skin_thickness torsion rolling "
    "palm_stiffness cone_ratio gear_stiffness gear_inertia rotor_inertia no_load_current thermal".split()
)
"""Parameters of the emulated hand that the MJCF has its own values for."""


class ForeignHand(EmulatedHand):
    """A user's hand with an object, trial after trial.

    Args:
      model: its MJCF, or a TOML with the names of its parts (`read_model`).
      hand, task, seed, others: see `EmulatedHand`.

    Raises:
      HandError: the MJCF does not fit the hand, or an override is of a parameter that the file decides.
    """

    def __init__(self, model: str | Path, hand: Hand, task: str, seed: int = 0, **others: Any):
        own = sorted(_OF_THE_FILE & set(others.get("overrides") or ()))
        if own:
            raise HandError(f"{own[0]} is not a parameter of a plant model: change it in {model}")
        self.model = read_model(model, hand)
        super().__init__(hand, task, seed, **others)

    def _make_parts(self) -> None:
        self._motors = self._drives = ForeignMotors(self.model, self.hand)
        self._skin = ContactTaxels(self.hand)

    def _build(self) -> Scene:
        scene = build_foreign_scene(self.model, self.parameters, self.shape, self._gravity)
        self._palm_face = palm_face(scene, PLACES[self.task])
        return scene

    def _enter(self, scene: Scene, place: Place) -> None:
        super()._enter(scene, place)
        self._motors.attach(scene.model)

    def _power(self) -> None:
        self._motors.step(self.time, self._scene.model, self._data)

    def _report(self) -> dict[str, Any]:
        report = super()._report()
        drawn = {name: value for name, value in report["parameters"].items() if name not in _OF_THE_FILE}
        return report | {"plant": self.model.path.name, "parameters": drawn}


def hand_of(model: str | Path | None, hand: Hand, task: str, seed: int = 0, **others: Any) -> EmulatedHand:
    """The emulated hand, with its own physics or those of a plant model; the arguments are those of `ForeignHand`."""
    return ForeignHand(model, hand, task, seed, **others) if model else EmulatedHand(hand, task, seed, **others)
