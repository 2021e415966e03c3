"""Options of `python -m dexsim_real.twin`: one dataclass that contains the options of every part."""

import dataclasses
from pathlib import Path

from dexsim.core.config import setting, validate
from dexsim_real.twin.plant.parameters import KINDS, TASKS
from dexsim_real.twin.plant.shapes import SHAPES
from dexsim_real.twin.wire.command_check import LimitsConfig
from dexsim_real.twin.wire.emulated_sensors import ObjectSensorConfig
from dexsim_real.twin.wire.faults import FaultConfig
from dexsim_real.twin.wire.firmware import FirmwareConfig
from dexsim_real.twin.wire.line import LineConfig


@dataclasses.dataclass(frozen=True, kw_only=True)
class TwinArguments:
    """Options of `python -m dexsim_real.twin`."""

    task: str = setting("rotate", choices=TASKS)
    """Task: `rotate` mounts the hand palm up with a cube, `grasp` upside down with various objects."""
    policy: str | None = None
    """Policy that will run on the hand, to check that it fits: a file, or the name of a shipped policy. None for the
    shipped policy of the task."""
    hand: str = ""
    """The TOML of a hand of your own, with the joints and taxels that the wire format has; empty for the XHand."""
    seed: int = setting(0, unit="1", low=0, high=2**31 - 1)
    """Seed of all random numbers: parameters, objects, noise, faults."""
    trials: int = setting(10, unit="1", low=1, high=100_000)
    """Number of trials, with one object each."""
    seconds: float | None = setting(None, unit="s", low=0.1, high=86400.0)
    """Time limit of a trial; None for that of the task (grasp 8 s, rotate 120 s)."""
    parameters: str = setting("outside", choices=KINDS)
    """Parameters of hand and object: just outside the ranges of training, inside them, or nominal."""
    first: int = setting(0, unit="1", low=0, high=100_000)
    """Number of the first trial. A trial does not depend on the trials before it."""
    shape: str = setting("any", choices=("any", *SHAPES))
    """Shape of the objects (grasp)."""
    command: float | None = setting(None, unit="1", low=0.0, high=1.0)
    """Grip command for the command line that is shown, and for the results; None leaves it out."""
    calibration: Path | None = None
    """Calibration file for the command line that is shown; None for a temporary file for nominal motors. `python -m
    dexsim_real.calibrate` creates one, as for a real hand."""
    link: Path | None = None
    """Path of the hand's port; None for one in a new temporary folder."""
    imu_link: Path | None = None
    """Path of the IMU's port (rotate); None for one in a new temporary folder."""
    mask_socket: Path | None = None
    """Path of the Unix socket for the camera's masks (grasp); None for one in a new temporary folder."""
    output: Path | None = None
    """JSON file for results, statistics and events, written at the end; None writes no file."""
    realtime: bool = True
    """Request real-time priority; continue without it if not permitted."""
    press: bool = False
    """A press bench in place of the trials: a pen on foam in front of the fingertip that `python -m
    dexsim_real.calibrate` presses."""
    plant_model: Path | None = None
    """MJCF of the hand by somebody else, which takes the place of the emulated hand's body, motors and contacts; or a
    TOML that names it and its parts (docs/emulated_hand.md). None for the emulated hand's own."""
    line: LineConfig = setting(LineConfig())
    """Timing of the serial line."""
    firmware: FirmwareConfig = setting(FirmwareConfig())
    """The palm board."""
    limits: LimitsConfig = setting(LimitsConfig())
    """Limits against which every command is checked."""
    faults: FaultConfig = setting(FaultConfig())
    """Injected faults."""
    object: ObjectSensorConfig = setting(ObjectSensorConfig())
    """IMU and camera of the object."""

    def __post_init__(self):
        validate(self)
