"""Scale of the force: newtons per taxel count by the gauge, how far it may be off, and taxels that read nothing."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from scipy.ndimage import binary_dilation

from dexsim.calibration.sensor import TaxelPress, fit_finger
from dexsim.core.errors import CalibrationError
from dexsim.hand.kinematics import Hand, forward_kinematics, taxel_normals
from dexsim_real.calibrate.read import PressSession, Recording
from dexsim_real.sensors.taxels import around

_ACTIVE = 2.0  # counts above which a taxel takes part
_NEIGHBOURS = 3.0  # counts, mean of a taxel's neighbours above which it must read something
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
    gauged: bool  # whether a finger had gauge readings
    notes: tuple[str, ...]


def force_scale(session: PressSession, hand: Hand, pressed: list[Recording]) -> ForceScale:
    """Compare the taxels with the gauge. A press without readings uses those of the finger's other press.

    Raises:
      CalibrationError: the readings do not rise with the force.
    """
    own: dict[int, float] = {}  # by finger: N per count as a run reads them
    newtons, error, notes = {}, {}, []
    for press in sorted(pressed, key=lambda r: not r.name.endswith("pad")):
        levels = {level: press.samples(level) for level in press.gauge if len(press.samples(level))}
        if len(levels) < _READINGS:
            if levels:
                notes.append(f"{press.name}: {len(levels)} gauge readings are ignored, {_READINGS} are needed")
            continue
        counts, shown, posture = (
            np.array([np.array(values)[rows].mean(0) for rows in levels.values()])
            for values in (press.counts, press.shown, press.position)
        )
        counts = counts * active_taxels(counts, hand.taxel_grid)
        # The fit applies this gain to sums with the dead taxels filled in.
        counts = fill_dead(hand, counts, dead_taxels(hand, counts))
        gauge = np.array([press.gauge[level] for level in levels]) / upright(hand, press.finger, counts, posture)
        try:
            whole, in_run = (
                fit_finger(TaxelPress(gauge, np.maximum(part, 0.0)[:, None])) for part in (counts.sum(-1), shown)
            )
        except CalibrationError as failure:
            raise CalibrationError(f"{press.name}, gauge: {failure}") from None
        newtons[press.name] = 1.0 / whole.gain.value, -whole.offset.value / whole.gain.value
        share = max(whole.gain.high - whole.gain.value, whole.gain.value - whole.gain.low) / whole.gain.value
        error[press.name] = float(np.hypot(share, _GAUGE))
        notes.append(
            f"{press.name}: {in_run.gain.widened(float(np.hypot(_GAUGE, _PLACE)))} counts per newton by the gauge "
            f"({in_run.samples} readings), {in_run.offset} counts at zero force"
        )
        own.setdefault(press.finger, 1.0 / in_run.gain.value)
    others = float(np.mean(list(own.values()))) if own else session.source.hardware.force_per_count
    per_count = np.array([own.get(finger, others) for finger in range(hand.num_fingers)])
    if not own:
        notes.append(f"no gauge: the taxels' scale is the nominal one, which may be {100 * _NOMINAL:.0f} % off")
    for finger, name in enumerate(hand.finger_names):
        if own and finger not in own:
            notes.append(
                f"{name}: not compared with the gauge; has the mean of the others (up to {100 * _OTHERS:.0f} % off)"
            )
    for press in pressed:
        newtons.setdefault(press.name, (float(per_count[press.finger]), 0.0))
        error.setdefault(press.name, _PLACE if press.finger in own else _OTHERS if own else _NOMINAL)
    return ForceScale(per_count, newtons, error, bool(own), tuple(notes))


def upright(hand: Hand, finger: int, counts: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Share [K] of each force [K, N] that the gauge shows: it stands still while the fingertip turns.

    It faces the fingertip at the smallest of the forces that the taxels feel, at joint angles [K, J]. Where they feel
    none their sum has any sign and direction: the share is then 1.
    """
    sums = counts.sum(-1)
    active = sums >= _ACTIVE
    if not active.any():
        return np.ones(len(counts))
    normals = [np.asarray(_normals(hand, finger, jnp.asarray(q, jnp.float32))) for q in position]
    push = np.array([weight @ normal for weight, normal in zip(np.maximum(counts, 0.0), normals, strict=True)])
    push /= np.maximum(np.linalg.norm(push, axis=-1, keepdims=True), 1e-9)
    return np.where(active, push @ push[np.where(active, sums, np.inf).argmin()], 1.0)


@functools.partial(jax.jit, static_argnames=("hand", "finger"))
def _normals(hand: Hand, finger: int, position: jax.Array) -> jax.Array:
    return taxel_normals(hand, forward_kinematics(hand, position))[finger]


def active_taxels(counts: np.ndarray, grid: tuple[int, int]) -> np.ndarray:
    """Mask [N] of the taxels that take part in counts [T, N] of a press, and of those beside them."""
    active = (counts.max(0) >= _ACTIVE).reshape(grid)
    return binary_dilation(active, np.ones((3, 3))).ravel()


def dead_taxels(hand: Hand, counts: np.ndarray) -> np.ndarray:
    """Mask [N] of taxels that read nothing in counts [T, N] of a press, although their neighbours did."""
    largest = counts.max(0)
    beside = np.where(around(hand, np.ones((1, hand.num_taxels))) > 0, around(hand, largest[None]), np.nan)[:, 0]
    # At least half of the neighbours must read, so that taxels at the edge of a press do not count as dead.
    pressed = (np.nanmean(beside, 0) >= _NEIGHBOURS) & (np.nanmedian(beside, 0) > 0.25 * _NEIGHBOURS)
    return (largest <= 0) & pressed


def fill_dead(hand: Hand, counts: np.ndarray, dead: np.ndarray) -> np.ndarray:
    """Counts [T, N] in which a dead taxel has the mean of its working neighbours."""
    working = (~dead).astype(float)
    near = around(hand, working[None])[:, 0]  # [8, N]
    mean = np.sum(around(hand, counts * working), 0) / np.maximum(near.sum(0), 1)
    return np.where(dead, mean, counts)
