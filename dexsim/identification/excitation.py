"""Joint targets that make an actuator show its parameters, within the joint limits; NumPy, made before a recording.

Chirps show inertia, damping and delay; steps the torque-speed envelope; slow triangles friction; small reversals
backlash.
"""

import dataclasses

import numpy as np
from scipy import signal

from dexsim.core.config import Config, Range, setting
from dexsim.core.errors import ConfigError
from dexsim.hand.description import Hand

MARGIN = 0.05
"""rad, kept from the joint's limits."""
_PAUSE = 0.3  # s, standing still between the parts of the chirp
_STEP = 0.4  # s at each step
_SLOW = 0.5  # rad/s, of the slow triangle
_REVERSAL, _REVERSAL_TIME = 0.02, 0.4  # rad, s: the small reversals


@dataclasses.dataclass(frozen=True, kw_only=True)
class Excitation(Config):
    """A recording's signals, in order."""

    period: float = setting(0.015, unit="s", low=0.001, high=0.1)
    """From one command to the next."""
    rest: float = setting(0.5, unit="s", low=0.0, high=10.0)
    """Standing still at the beginning and between the signals."""
    amplitude: float = setting(0.3, unit="rad", low=0.005, high=1.5)
    """Of chirp, steps and slow triangles about the middle posture; cut to the joint's range."""
    chirp_frequency: Range = setting((0.3, 4.0), unit="Hz", low=0.01, high=50.0)
    """First and last frequency of the chirp."""
    chirp_seconds: float = setting(4.0, unit="s", low=0.0, high=120.0)
    """Length of the chirp; its amplitude falls with the frequency to a quarter."""
    chirp_parts: int = setting(6, unit="1", low=1, high=100)
    """Parts that the chirp is cut into, with a pause after each: where the joint rests, an
    identification can begin anew, and errors within a dead-band do not pile up."""
    step_count: int = setting(6, unit="1", low=0, high=200)
    """Steps, of alternating sign and two sizes."""
    reversal_cycles: int = setting(4, unit="1", low=0, high=200)
    """Small reversals, once up and down each."""


def joint_excitation(config: Excitation, middle: float, reach: float) -> np.ndarray:
    """Targets [T] rad of one joint about `middle`, no farther than `reach` from it."""
    size, period = min(config.amplitude, reach), config.period
    rest, pause = (np.zeros(round(seconds / period)) for seconds in (config.rest, _PAUSE))
    ladder = np.linspace(*config.chirp_frequency, config.chirp_parts + 1)
    fading = np.linspace(1.0, 0.25, config.chirp_parts + 1)
    seconds = config.chirp_seconds / config.chirp_parts
    time, bursts = np.arange(0.0, seconds, period), list[np.ndarray]()
    for first, second, strength in zip(ladder[:-1], ladder[1:], fading[:-1], strict=True):
        bursts += [size * strength * signal.chirp(time, first, max(seconds, period), second, phi=-90), pause]
    levels = np.resize((1.0, -1.0, 1 / 3, -1 / 3), config.step_count)
    signals = [
        np.concatenate(bursts),
        size * np.repeat(levels, max(round(_STEP / period), 1)),
        _triangles(size, 1, 4 * size / _SLOW, period),
        _triangles(min(_REVERSAL, reach), config.reversal_cycles, _REVERSAL_TIME, period),
    ]
    return middle + np.concatenate([rest, *(part for wave in signals for part in (wave, rest))])


def _triangles(size: float, cycles: int, seconds: float, period: float) -> np.ndarray:
    """[T] rad, triangle waves of `seconds` s each, from 0 up, down and back."""
    phase = np.arange(0.0, cycles * seconds, period) / seconds
    return size * signal.sawtooth(2 * np.pi * (phase + 0.25), 0.5)


def excitation(
    hand: Hand, config: Excitation, posture: np.ndarray | None = None, joints: tuple[str, ...] | None = None
) -> dict[str, np.ndarray]:
    """Targets [T, J] rad, every `config.period`, by the name of the joint that moves while the others rest.

    Args:
      posture: [J] rad, where joints rest and about which they move; the middle of their ranges by default. An open hand
        keeps fingers from touching each other.
      joints: which to move; all by default.

    Raises:
      ConfigError: an unknown joint, or a posture too close to a limit to move.
    """
    if posture is None:
        posture = (hand.joint_lower + hand.joint_upper) / 2
    posture = np.asarray(posture, float)
    low, high = hand.joint_lower + MARGIN, hand.joint_upper - MARGIN
    targets = {}
    for name in joints or hand.joint_names:
        if name not in hand.joint_names:
            raise ConfigError(f"no joint {name!r} in hand {hand.name}")
        joint = hand.joint_names.index(name)
        reach = min(posture[joint] - low[joint], high[joint] - posture[joint])
        if reach < 0.02:
            raise ConfigError(
                f"{name}: {posture[joint]:.3g} rad lies {max(reach, 0):.2g} rad from "
                f"the end of its range less the margin: too close to move"
            )
        moving = joint_excitation(config, posture[joint], reach)
        targets[name] = np.tile(posture, (len(moving), 1))
        targets[name][:, joint] = moving
    return targets
