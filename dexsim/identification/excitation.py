"""Joint targets that make a drive show its parameters, within the joint limits; NumPy, made before a recording.

Chirps show inertia, damping and delay; steps the torque-speed envelope; slow triangles friction; small reversals
backlash.
"""

from typing import Any

import numpy as np
from scipy import signal

from dexsim.errors import ConfigError
from dexsim.hand.description import Hand

MARGIN = 0.05
"""rad, kept from the joint's limits."""
_REST = 0.5  # s, standing still at the beginning and between the signals
_PART, _PAUSE = 2 / 3, 0.3  # s, of the chirp, and standing still after each
_STEP = 0.4  # s at each step
_SLOW = 0.5  # rad/s, of the slow triangle
_REVERSAL, _REVERSAL_TIME, _REVERSALS = 0.02, 0.4, 4  # rad, s each, number: the small reversals


def joint_excitation(
    period: float,
    middle: float,
    reach: float,
    *,
    amplitude: float = 0.3,
    frequency: tuple[float, float] = (0.3, 4.0),
    seconds: float = 4.0,
    steps: int = 6,
) -> np.ndarray:
    """Targets [T] rad of one joint about `middle`, no farther than `reach` from it, every `period` s.

    Args:
      amplitude: rad, of chirp, steps and slow triangles.
      frequency: Hz, at the beginning and the end of the chirp, whose amplitude falls to a quarter.
      seconds: length of the chirp. It pauses where an identification can begin anew (`joint.segments`), so that errors
        within a dead-band do not pile up.
      steps: number of steps, of alternating sign and two sizes.
    """
    size = min(amplitude, reach)
    rest, pause = (np.zeros(round(time / period)) for time in (_REST, _PAUSE))
    parts = max(round(seconds / _PART), 1)
    ladder, fading = np.linspace(*frequency, parts + 1), np.linspace(1.0, 0.25, parts + 1)
    time, bursts = np.arange(0.0, seconds / parts, period), list[np.ndarray]()
    for first, second, strength in zip(ladder[:-1], ladder[1:], fading[:-1], strict=True):
        bursts += [size * strength * signal.chirp(time, first, seconds / parts, second, phi=-90), pause]
    signals = [
        np.concatenate(bursts),
        size * np.repeat(np.resize((1.0, -1.0, 1 / 3, -1 / 3), steps), round(_STEP / period)),
        _triangles(size, 1, 4 * size / _SLOW, period),
        _triangles(min(_REVERSAL, reach), _REVERSALS, _REVERSAL_TIME, period),
    ]
    return middle + np.concatenate([rest, *(part for wave in signals for part in (wave, rest))])


def _triangles(size: float, cycles: int, seconds: float, period: float) -> np.ndarray:
    """[T] rad, triangle waves of `seconds` s each, from 0 up, down and back."""
    phase = np.arange(0.0, cycles * seconds, period) / seconds
    return size * signal.sawtooth(2 * np.pi * (phase + 0.25), 0.5)


def excitation(
    hand: Hand,
    period: float,
    posture: np.ndarray | None = None,
    joints: tuple[str, ...] | None = None,
    **signals: Any,
) -> dict[str, np.ndarray]:
    """Targets [T, J] rad, every `period` s, by the name of the joint that moves while the others rest.

    Args:
      posture: [J] rad, where joints rest and about which they move; the middle of their ranges by default. An open hand
        keeps fingers from touching each other.
      joints: which to move; all by default.
      signals: options of `joint_excitation`.

    Raises:
      ConfigError: an unknown joint, or a posture too close to a limit to move.
    """
    if posture is None:
        posture = (hand.joint_lower + hand.joint_upper) / 2
    posture = np.asarray(posture, float)
    room = np.minimum(posture - hand.joint_lower, hand.joint_upper - posture) - MARGIN
    targets = {}
    for name in joints or hand.joint_names:
        if name not in hand.joint_names:
            raise ConfigError(f"no joint {name!r} in hand {hand.name}")
        joint = hand.joint_names.index(name)
        if room[joint] < 0.02:
            raise ConfigError(
                f"{name}: {posture[joint]:.3g} rad is {room[joint] + MARGIN:.2g} rad from the end of its range: "
                f"at least {MARGIN + 0.02:g} rad are needed"
            )
        moving = joint_excitation(period, posture[joint], room[joint], **signals)
        targets[name] = np.tile(posture, (len(moving), 1))
        targets[name][:, joint] = moving
    return targets
