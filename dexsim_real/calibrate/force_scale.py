"""Scale of the force: newtons per taxel count by the gauge, and how far it may be off."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from scipy.ndimage import binary_dilation

from dexsim.calibration.sensor import FingerFit, TaxelPress, fit_finger
from dexsim.core.errors import CalibrationError, DexsimError
from dexsim.hand.kinematics import Hand, forward_kinematics, taxel_normals
from dexsim_real.calibrate.read import PressSession, Recording
from dexsim_real.calibrate.taxel_check import dead_taxels, fill_dead

ACTIVE = 2.0
"""Counts above which a taxel takes part."""
_READINGS = 8  # gauge readings that a fingertip needs
# Shares of the scale, 95 %, that no reading shows:
_GAUGE = 0.015  # of the gauge itself, and of how straight it stands under the press
_PLACE = 0.08  # between places on a fingertip, whose taxels differ
_NOMINAL = 0.25  # of the taxels without a gauge
_OTHERS = 0.35  # of a fingertip without a gauge from those with one


@dataclasses.dataclass(frozen=True)
class ForceScale:
    """Newtons of taxel counts."""

    per_count: np.ndarray  # [F] N, for a run
    newtons: dict[str, tuple[float, float]]  # by press: gain and offset, newtons = gain * counts + offset
    error: dict[str, float]  # by press: share of the gain, 95 %
    sensors: dict[str, FingerFit]  # by finger with gauge readings: counts as in a run against newtons
    notes: tuple[str, ...]


def force_scale(session: PressSession, hand: Hand, pressed: list[Recording]) -> ForceScale:
    """Compare the taxels with the gauge. A press without readings uses those of the finger's other press.

    Raises:
      CalibrationError: the readings do not rise with the force.
    """
    nominal = session.hardware.force_per_count
    newtons, error, fits, notes = {}, {}, dict[str, FingerFit](), list[str]()
    for recording in sorted(pressed, key=lambda r: not r.name.endswith("pad")):
        levels = [level for level in recording.gauge if len(recording.samples(level))]
        if len(levels) < _READINGS:
            if levels:
                notes.append(f"{recording.name}: {len(levels)} gauge readings are ignored, {_READINGS} are needed")
            continue
        every, readings = np.array(recording.counts), np.array(recording.shown)
        counts = np.array([every[recording.samples(level)].mean(0) for level in levels])
        active = binary_dilation((counts.max(0) >= ACTIVE).reshape(hand.taxel_grid), np.ones((3, 3))).ravel()
        counts = counts * active
        # The fit applies this gain to sums with the dead taxels filled in.
        counts = fill_dead(hand, counts, dead_taxels(hand, counts, session.check.neighbours))
        posture = [np.array(recording.position)[recording.samples(level)].mean(0) for level in levels]
        gauge = np.array([recording.gauge[level] for level in levels])
        gauge = gauge / upright(hand, recording.finger, counts, np.array(posture))
        run = np.array([readings[recording.samples(level)].mean() for level in levels])
        whole, sensor_fit = (_against(gauge, part, recording.name) for part in (counts.sum(-1), run))
        newtons[recording.name] = 1.0 / whole.gain.value, -whole.offset.value / whole.gain.value
        share = max(whole.gain.high - whole.gain.value, whole.gain.value - whole.gain.low) / whole.gain.value
        error[recording.name] = float(np.hypot(share, _GAUGE))
        sensor_fit = dataclasses.replace(sensor_fit, gain=sensor_fit.gain.widened(float(np.hypot(_GAUGE, _PLACE))))
        notes.append(
            f"{recording.name}: {sensor_fit.gain} counts per newton by the gauge ({sensor_fit.samples} readings), "
            f"{sensor_fit.offset} counts at zero force"
        )
        fits.setdefault(hand.finger_names[recording.finger], sensor_fit)
    own = {name: 1.0 / sensor_fit.gain.value for name, sensor_fit in fits.items()}
    others = float(np.mean(list(own.values()))) if own else nominal
    per_count = np.array([own.get(name, others) for name in hand.finger_names])
    notes += [
        f"{name}: not compared with the gauge; has the mean of the other fingers (up to {100 * _OTHERS:.0f} % off)"
        for name in hand.finger_names
        if own and name not in own
    ]
    if not own:
        notes.append(f"no gauge: the taxels' scale is the nominal one, which may be {100 * _NOMINAL:.0f} % off")
    for recording in pressed:
        finger = hand.finger_names[recording.finger]
        newtons.setdefault(recording.name, (float(per_count[recording.finger]), 0.0))
        error.setdefault(recording.name, _PLACE if finger in own else _OTHERS if own else _NOMINAL)
    return ForceScale(per_count, newtons, error, fits, tuple(notes))


def upright(hand: Hand, finger: int, counts: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Share [K] of each force [K, N] that the gauge shows: it stands still while the fingertip turns.

    It faces the fingertip at the smallest of the forces that the taxels feel, at joint angles [K, J]. Where they feel
    none their sum has any sign and direction: the share is then 1.
    """
    sums = counts.sum(-1)
    active = sums >= ACTIVE
    if not active.any():
        return np.ones(len(counts))
    normals = [_normals(hand, jnp.int32(finger), jnp.asarray(q, jnp.float32)) for q in position]
    weights = np.maximum(counts, 0.0)
    push = np.array([weight @ np.asarray(normal) for weight, normal in zip(weights, normals, strict=True)])
    push /= np.maximum(np.linalg.norm(push, axis=-1, keepdims=True), 1e-9)
    return np.where(active, push @ push[np.where(active, sums, np.inf).argmin()], 1.0)


@functools.partial(jax.jit, static_argnames="hand")
def _normals(hand: Hand, finger: jax.Array, position: jax.Array) -> jax.Array:
    return taxel_normals(hand, forward_kinematics(hand, position))[finger]


def _against(gauge: np.ndarray, counts: np.ndarray, name: str) -> FingerFit:
    try:
        return fit_finger(TaxelPress(gauge, np.maximum(counts, 0.0)[:, None]))
    except DexsimError as error:
        raise CalibrationError(f"{name}, gauge: {error}") from None
