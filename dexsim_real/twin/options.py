"""Options of `python -m dexsim_real.twin`."""

import dataclasses
from pathlib import Path

from dexsim.core.config import Config, setting
from dexsim_real.twin.plant.parameters import KINDS, TASKS
from dexsim_real.twin.plant.shapes import SHAPES


@dataclasses.dataclass(frozen=True, kw_only=True)
class TwinArguments(Config):
    """Options of `python -m dexsim_real.twin`."""

    task: str = setting("rotate", choices=TASKS)
    """Task: `rotate` mounts the hand palm up with a cube, `grasp` upside down with various objects."""
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
    plant_model: Path | None = None
    """Third-party MJCF of the hand, which takes the place of the emulated hand's body and contacts; or a TOML that
    names it and its parts (docs/emulated_hand.md). Its motors are left out: the emulated hand's drive its joints. None
    for the emulated hand's own."""
    faults: tuple[str, ...] = ()
    """Injected faults, each "12.5 stall 0.2" (seconds after the first exchange, kind, values) or "1% flip" (share of
    the exchanges). Values that are left out are sampled. `flip|drop|duplicate answer|request`, `late|stall|disconnect
    SECONDS`, `heat JOINT|tipTIP|palm KELVIN SECONDS`, `error palm|joint|tip JOINT BITS SECONDS`, `off JOINT SECONDS`
    (-1: all), `jam JOINT MILLIAMPERES SECONDS`, `refuse NUMBER SECONDS`, `angle JOINT offset|stuck RADIANS SECONDS`,
    `stuck TIP TAXEL COUNT`."""
