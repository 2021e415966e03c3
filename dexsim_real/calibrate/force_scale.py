"""Scale of the force: newtons per taxel count by the gauge, how far it may be off, and taxels that read nothing."""

import dataclasses

import numpy as np
from scipy.ndimage import binary_dilation

from dexsim.calibration.sensor import TaxelPress, fit_finger
from dexsim.core.errors import CalibrationError
from dexsim.hand.description import Hand
from dexsim_real.calibrate.read import Recording, Source
from dexsim_real.sensors.taxels import around

_ACTIVE = 2.0  # counts above which a taxel takes part
_NEIGHBOURS = 3.0  # counts, mean of a taxel's neighbours above which it must read something
_READINGS = 8  # gauge readings that a fingertip needs
# Shares of the scale, 95 %, that no reading shows:
_GAUGE = 0.03  # of the gauge itself, and of how straight it stands under a fingertip that turns by up to 0.25 rad
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


def force_scale(source: Source, hand: Hand, pressed: list[Recording]) -> ForceScale:
    """Compare the taxels with the gauge. A press without readings uses those of the finger's other press.

    Raises:
      CalibrationError: the readings do not rise with the force.
    """
    own: dict[int, float] = {}  # by finger: N per count
    newtons, error, notes = {}, {}, []
    for press in sorted(pressed, key=lambda r: not r.name.endswith("pad")):
        levels = {level: press.samples(level) for level in press.gauge if len(press.samples(level))}
        if len(levels) < _READINGS:
            if levels:
                notes.append(f"{press.name}: {len(levels)} gauge readings are ignored, {_READINGS} are needed")
            continue
        counts = np.array([np.array(press.counts)[rows].mean(0) for rows in levels.values()])
        counts = counts * active_taxels(counts, hand.taxel_grid)
        # The fit applies this gain to sums with the dead taxels filled in.
        counts = fill_dead(hand, counts, dead_taxels(hand, counts))
        gauge = np.array([press.gauge[level] for level in levels])
        try:
            line = fit_finger(TaxelPress(gauge, np.maximum(counts.sum(-1), 0.0)[:, None])).line
        except CalibrationError as failure:
            raise CalibrationError(f"{press.name}, gauge: {failure}") from None
        newtons[press.name] = 1.0 / line.gain, -line.offset / line.gain
        error[press.name] = float(np.hypot(line.gain_share, _GAUGE))
        low, high = line.widened(float(np.hypot(_GAUGE, _PLACE))).gain_interval
        notes.append(
            f"{press.name}: {line.gain:.3g} [{low:.3g}, {high:.3g}] counts per newton by the gauge "
            f"({line.samples} readings), {line.offset:.1f} counts at zero force"
        )
        own.setdefault(press.finger, 1.0 / line.gain)
    others = float(np.mean(list(own.values()))) if own else source.hardware.force_per_count
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
