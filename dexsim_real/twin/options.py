"""Options of `python -m dexsim_real.twin`, one dataclass with those of every part within."""

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
    """What the hand is mounted for: palm up with a cube, or upside down with objects to catch."""
    policy: str | None = None
    """The policy that will run on it, a file or a shipped name, to see that it fits; by default that of the task's
    name."""
    seed: int = setting(0, unit="1", low=0, high=2**31 - 1)
    """Of everything random: parameters, objects, noise, faults."""
    trials: int = setting(10, unit="1", low=1, high=100_000)
    """Objects that are handed over before the program ends."""
    seconds: float | None = setting(None, unit="s", low=0.1, high=86400.0)
    """Time limit of a trial; the task's own by default (grasp 8, rotate 120)."""
    draw: str = setting("outside", choices=KINDS)
    """Parameters just outside the ranges of training, inside them, or nominal."""
    first: int = setting(0, unit="1", low=0, high=100_000)
    """Number of the first trial: a trial is the same whether others went before it or not."""
    shape: str = setting("any", choices=("any", *SHAPES))
    """Objects of grasp trials."""
    command: float | None = setting(None, unit="1", low=0.0, high=1.0)
    """Grip command that the runner will be given; only noted in the results and in the command shown."""
    calibration: Path | None = None
    """Calibration file for the command shown; by default that of a hand whose motors are all nominal, which is written
    to a temporary folder. `python -m dexsim_real.calibrate` makes one as for a real hand."""
    link: Path | None = None
    """Name of the hand's port; by default in a new folder under the system's temporary one."""
    imu_link: Path | None = None
    """Name of the IMU's port (rotate)."""
    mask_socket: Path | None = None
    """Unix socket of the camera's masks (grasp)."""
    output: Path | None = None
    """File for results, counters and events as JSON, written at the end."""
    realtime: bool = True
    """Ask for real-time priority: it stands for hardware, which waits for no scheduler."""
    plant: str | None = None
    """MODULE:FUNCTION of your own that makes the physics (`dexsim_real.twin.plant.protocol.Plant`) from these options."""
    line: LineConfig = setting(LineConfig())
    """Timing of the wire."""
    firmware: FirmwareConfig = setting(FirmwareConfig())
    """The palm board."""
    limits: LimitsConfig = setting(LimitsConfig())
    """What every command is held against."""
    faults: FaultConfig = setting(FaultConfig())
    """What goes wrong."""
    object: ObjectSensorConfig = setting(ObjectSensorConfig())
    """IMU and camera."""

    def __post_init__(self):
        validate(self)
