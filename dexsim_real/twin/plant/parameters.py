"""Parameters of the hand and the object in a trial on the emulated hand, sampled just outside training's ranges.

Each `Band` is a range of a task's default configuration, with its place there. A value is beyond one end of its range,
by 5 to 15 % of the width. Every joint, finger and trial samples its own end; where one end is impossible (a negative
gear play, an efficiency above one) the other is used. To find out what breaks a policy, the kind "inside" samples
within the ranges, and "nominal" takes their middle or neutral value. `STRUCTURE` holds what training does not model
(torsional friction, thermal effects, ...) and is in every trial.

Rubber and friction have ranges of the emulated hand's own (`sides` "within"), which do not follow training's: training
may not choose what it is tested by. The other ranges repeat training's; a test compares them.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np

from dexsim.hand.description import Hand
from dexsim_real.core.errors import HandError

KINDS = ("outside", "inside", "nominal")
TASKS = ("grasp", "rotate", "rotate_any", "rotate_clear")
"""rotate_any: boxes and cylinders in place of a cube, on a palm that leans as in training; rotate_clear: the fingers
hold the cube clear of the palm."""
NEAR, FAR = 0.05, 0.15  # beyond an edge, as shares of the range's width
EXCHANGE_COMMAND = 0.007  # s from a policy tick to the board: half a period at 83 Hz and 1 ms on the wire
EXCHANGE_SENSE = 0.0146  # s from the board to a policy tick: 8.6 ms of reply and half a period
_COUNT = {"trial": (), "joint": (12,), "finger": (5,), "axis": (3,), "plane": (2,)}


@dataclasses.dataclass(frozen=True)
class Band:
    """A range of training, from which values inside, outside or at the nominal point are taken."""

    low: float
    high: float
    unit: str
    origin: str  # path in a task's configuration; empty: the emulated hand's own
    nominal: float
    per: str = "trial"  # one value per "trial", "joint", "finger", "axis" or "plane"
    sides: str = "both"  # possible ends: "both", "high", "low"; "within": the hand's own range, not training's

    def sample(self, rng: np.random.Generator, kind: str, count: Mapping[str, tuple[int, ...]] = _COUNT) -> np.ndarray:
        """Sample values of a kind in `KINDS`; the shape follows from `per`, by the `count` of joints and fingers."""
        shape, width = count[self.per], self.high - self.low
        # Every kind consumes the same random numbers, so that kinds differ in nothing else.
        side, place = rng.random(shape), rng.random(shape)
        if kind == "nominal":
            return np.full(shape, self.nominal)
        if kind == "inside":
            return self.low + place * width
        below = (self.low - FAR * width, self.low - NEAR * width)
        above = (self.high + NEAR * width, self.high + FAR * width)
        sides = {"both": (below, above), "low": (below,), "high": (above,), "within": ((self.low, self.high),)}
        spans = np.array(sides[self.sides])
        low, high = spans[(side * len(spans)).astype(int)].T
        return (low + place.T * (high - low)).T


BANDS: dict[str, Band] = {
    # --- the drive, per joint
    "stiffness": Band(0.8, 1.2, "1", "randomization.stiffness_factor", 1.0, "joint"),
    "damping": Band(0.7, 1.3, "1", "randomization.damping_factor", 1.0, "joint"),
    "gear_play": Band(0.0, 0.01, "rad", "randomization.dead_band", 0.0, "joint", "high"),
    "torque": Band(0.9, 1.1, "1", "randomization.torque_factor", 1.0, "joint"),
    "speed": Band(0.9, 1.1, "1", "randomization.speed_factor", 1.0, "joint"),
    "efficiency": Band(0.85, 1.0, "1", "randomization.efficiency", 1.0, "joint", "low"),
    "ripple": Band(0.0, 0.03, "1", "randomization.ripple", 0.0, "joint", "high"),
    "ripple_count": Band(20.0, 200.0, "1/rad", "randomization.ripple_count", 100.0, "joint", "high"),
    "coulomb_friction": Band(0.0, 0.03, "1", "randomization.coulomb_friction", 0.0, "joint", "high"),
    "viscous_friction": Band(0.0, 0.01, "Nm s/rad", "randomization.viscous_friction", 0.0, "joint", "high"),
    "latency": Band(0.0, 0.02, "s", "randomization.latency", 0.0, "trial", "high"),
    "latency_spread": Band(0.0, 0.005, "s", "randomization.latency_spread", 0.0, "joint", "high"),
    # --- the sensors of the hand
    "sensing_latency": Band(0.0, 0.02, "s", "randomization.sensing_latency", 0.0, "trial", "high"),
    "encoder_bias": Band(-0.01, 0.01, "rad", "randomization.encoder_bias", 0.0, "joint"),
    "current_gain": Band(0.9, 1.1, "1", "randomization.torque_gain", 1.0, "joint"),
    "taxel_gain": Band(0.9, 1.1, "1", "randomization.taxel_gain", 1.0, "finger"),
    # --- the mount
    "gravity_tilt": Band(-0.1, 0.1, "rad", "randomization.gravity_tilt", 0.0, "plane"),
    # --- the object and its contacts
    "inertia_scale": Band(0.8, 1.25, "1", "objects.inertia_scale", 1.0),
    "com_offset": Band(-0.003, 0.003, "m", "objects.com_offset", 0.0, "axis"),
    "friction": Band(0.35, 1.1, "1", "", 0.8, sides="within"),  # rubber: dusty to clean
    "link_friction": Band(0.25, 1.0, "1", "", 0.5, sides="within"),  # plastic and painted metal
    "stiffness_contact": Band(1600.0, 1800.0, "N/m", "objects.stiffness", 1700.0),
    "restitution": Band(0.03, 0.08, "1", "objects.restitution", 0.05),
    # Beyond the taxels; the maker's shell is within 0.5 mm.
    "rubber": Band(0.0, 0.001, "m", "", 0.0005, sides="within"),
}
"""Bands of both tasks; `TASK_BANDS` adds to them or replaces them."""

TASK_BANDS: dict[str, dict[str, Band]] = {
    "grasp": {
        "mass": Band(0.05, 0.20, "kg", "objects.mass", 0.12),
        "sphere_radius": Band(0.022, 0.035, "m", "objects.sphere_radius", 0.028),
        "box_half": Band(0.020, 0.030, "m", "objects.box_half", 0.025, "axis"),
        "cylinder_radius": Band(0.020, 0.030, "m", "objects.cylinder_radius", 0.025),
        "cylinder_half": Band(0.020, 0.035, "m", "objects.cylinder_half", 0.027),
        "neck_radius": Band(0.010, 0.016, "m", "objects.neck_radius", 0.013),
        "neck_half": Band(0.008, 0.018, "m", "objects.neck_half", 0.013),
        "gap": Band(0.001, 0.009, "m", "release_gap", 0.005, "trial", "high"),
        "release_speed": Band(0.0, 0.1, "m/s", "", 0.0, "trial", "high"),  # training lets objects go at rest
        "reaction": Band(0.1, 0.5, "s", "release_delay", 0.3, sides="within"),
    },
    "rotate": {
        "mass": Band(0.06, 0.15, "kg", "objects.mass", 0.10),
        "edge": Band(0.050, 0.060, "m", "edge", 0.055),
        "imu_bias": Band(-0.04, 0.04, "rad", "sensing.orientation.bias", 0.0, "axis"),
        "imu_drift": Band(-0.0005, 0.0005, "rad/s", "sensing.orientation.drift", 0.0, "trial"),
        "imu_delay": Band(0.0, 0.02, "s", "sensing.orientation.delay", 0.0, "trial", "high"),
    },
}

STRUCTURE: dict[str, float | tuple[float, ...]] = {
    "skin_thickness": 0.003,  # m of rubber that is squeezed
    "torsion": 0.002,  # m, ratio of torsional to sliding friction of the rubber
    "rolling": 0.0001,  # m, rolling friction
    "palm_stiffness": 8000.0,  # N/m, plastic without rubber
    "cone_ratio": 100.0,  # impratio: stiffness of friction relative to the normal direction
    "gear_stiffness": 150.0,  # Nm/rad of the closed gear
    "gear_inertia": 1e-5,  # kg m^2 of the gear's last stage, at the joint
    "rotor_inertia": 1.0,  # factor on the rotors' reflected inertia (`scene.ROTORS`)
    "no_load_current": 0.01,  # A
    "thermal": 1.0,  # factor on thermal effects; 0: motors stay cold
    "current_noise": 0.012,  # A
    "encoder_noise": 0.001,  # rad
    "taxel_noise": 0.015,  # N
    "taxel_bias": 0.02,  # N, standard deviation
    "taxel_drift": 0.05,  # N, standard deviation of how far a zero wanders as the fingertips warm up
    "taxel_spread": 0.08,  # standard deviation of the gains
    "taxel_threshold": 0.06,  # N
    "taxel_crosstalk": 0.06,  # share of a taxel's force that spreads to its neighbours
    "camera_noise": 0.0025,  # m, white noise of the object's position after segmentation
    "camera_delay": 0.03,  # s from a picture to its mask
    "imu_noise": 0.01,  # rad, white noise
    "heading_error": 0.05,  # rad, largest heading error when the object is placed
    "place_error": 0.004,  # m, largest position error when the object is placed
    "push_rate": 1.0,  # factor on the rate of pushes (`PUSHES`)
    "push_seconds": 0.03,  # s, duration of a push
}
"""Parameters that training does not randomise or does not model: one value for all trials."""

OF_THE_FILE = frozenset(
    "friction link_friction stiffness_contact restitution rubber torsion rolling palm_stiffness cone_ratio".split()
)
"""Parameters that a plant model has its own values for."""

TASK_BANDS["rotate_clear"] = TASK_BANDS["rotate"]
TASK_BANDS["rotate_any"] = TASK_BANDS["rotate"] | {
    "edge": Band(0.045, 0.065, "m", "", 0.055, sides="within"),
    "proportions": Band(0.9, 1.1, "1", "", 1.0, "axis", sides="within"),
    "gravity_tilt": Band(-0.4, 0.4, "rad", "", 0.0, "plane", sides="within"),
}

PUSHES = {"grasp": (0.5, 0.3), "rotate": (1 / 6, 0.1)}
"""Pushes per second, and largest change of velocity m/s by a push, as in the evaluation of each task."""


def skill_of(task: str) -> str:
    """grasp or rotate."""
    return task.partition("_")[0]


class TrialParameters(SimpleNamespace):
    """Parameters of one trial, by the names in `BANDS`, `TASK_BANDS` and `STRUCTURE`, as attributes and in `value`."""

    def __init__(self, task: str, value: dict[str, np.ndarray]):
        numbers = {name: number if number.ndim else float(number) for name, number in value.items()}
        super().__init__(task=task, value=value, **numbers)


def sample_trial(
    task: str,
    rng: np.random.Generator,
    kind: str = "outside",
    overrides: Mapping[str, float] | None = None,
    hand: Hand | None = None,
) -> TrialParameters:
    """Sample the parameters of a trial. `hand` gives the number of joints and fingers, None is the XHand; `overrides`
    by name a value, the same for all joints, fingers or axes. HandError: there is no such parameter."""
    table, given = BANDS | TASK_BANDS[task], overrides or {}
    if unknown := sorted(given.keys() - table.keys() - STRUCTURE.keys()):
        known = ", ".join(sorted(table | STRUCTURE))
        raise HandError(f"the emulated hand has no parameter {unknown[0]!r}; choose from {known}")
    count = _COUNT | ({"joint": (hand.num_joints,), "finger": (hand.num_fingers,)} if hand else {})
    value = {name: table[name].sample(rng, kind, count) for name in sorted(table)}
    value |= {name: np.asarray(number, float) for name, number in STRUCTURE.items()}
    value |= {name: np.full_like(value[name], number) for name, number in given.items()}
    return TrialParameters(task, value)


# --- where trials begin ------------------------------------------------------------------------------

GRAVITY = 9.81  # m/s^2
ROTATE_PLACE = (0.007, 0.079)
"""Position along the palm (y, z) m of a right hand where a cube is placed: the centre of the start states in training.
Few of them are 5 mm nearer to the wrist, and a policy may miss an object there (docs/camera.md)."""
CLEAR_POSTURE = (1.2, 0.3, 0.3, 0.0, 0.8, 0.6, 0.8, 0.6, 0.8, 0.6, 0.8, 0.6)  # rad, of the XHand
CLEAR_REFERENCE, CLEAR_PLACE = (0.072, 0.005, 0.098), (0.066, 0.007, 0.099)
"""Nominal position, m, of a cube that turns clear of the palm, and where it is placed: the mean of the start states."""


class Start(NamedTuple):
    """Where the trials of a hand begin, and its mount; palm frame."""

    posture: np.ndarray  # [J] rad
    reference: np.ndarray  # [3] m, nominal position of the object
    place: np.ndarray  # [2] m, y and z where it is placed on the palm; [3] m, x as well: between the fingertips
    gravity: np.ndarray  # [3] m/s^2
    turn: float = np.pi / 2  # rad from one goal to the next, about the axis
    axis: np.ndarray = np.array((1.0, 0.0, 0.0))

    @property
    def clear(self) -> bool:
        """Whether the fingers hold the object clear of the palm."""
        return len(self.place) == 3

    @property
    def upright(self) -> np.ndarray:
        """The direction [3] that a face of the object is across at the start."""
        return self.axis if self.clear else np.array((1.0, 0.0, 0.0))


def start_of(hand: Hand, task: str, axis: Sequence[float] = ()) -> Start:
    """The start by the hand's TOML, and the axis [3] of rotation of a right hand; empty: that of the task. Goals, mount
    and place of a left hand are the mirror image of those of a right one. HandError: there is none in the TOML."""
    side = hand.thumb_side
    mirror, quarter = np.array((1.0, side, 1.0)), side * np.pi / 2
    if task == "rotate_clear":
        if hand.num_joints != len(CLEAR_POSTURE):
            raise HandError(f"{hand.name}: the emulated hand has the start of rotate_clear for the XHand only")
        middle, place, curled = mirror * CLEAR_REFERENCE, mirror * CLEAR_PLACE, np.array((0.6, 0.0, -0.8))
        return Start(np.array(CLEAR_POSTURE), middle, place, gravity(-1.1, 0.0, side), quarter, curled)
    if skill_of(task) == "grasp":
        posture, reference, names = hand.grasp_posture, hand.grasp_centre, "[grasp] with posture and centre"
        place, down = np.array(reference[1:]), GRAVITY * np.array([1.0, 0.0, 0.0])
    else:
        posture, reference, names = hand.rotate_posture, hand.rotate_reference, "[rotate] with posture and reference"
        place, down = mirror[1:] * ROTATE_PLACE, gravity(-0.2, -0.2, side)
    if not (posture and reference):
        raise HandError(f"{hand.name}: the emulated hand needs a {names} in its TOML")
    return Start(
        np.array(posture), np.array(reference), place, down, quarter, mirror * np.array(axis or (1.0, 0.0, 0.0))
    )


def gravity(pitch: float, roll: float, side: float) -> np.ndarray:
    """Gravity [3] m/s^2 in the palm frame of a hand that is palm up but for angles in rad, by which wrist and thumb
    side are lowered, or raised where negative."""
    return GRAVITY * np.array([-np.cos(pitch) * np.cos(roll), side * np.sin(roll), -np.sin(pitch) * np.cos(roll)])
