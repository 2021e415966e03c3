"""System identification: actuator parameters from commanded and measured joint positions.

Output error: the joint is simulated from the commands alone (`dexsim.identification.joint`), and the
parameters are moved until its readings are the log's. Smooth parameters go by the gradient through
the jitted simulation; latency is a whole number and the dead-band a threshold, so they are
searched outside of it (`dexsim.identification.search`).
"""

import dataclasses
from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np

from dexsim.core.errors import CalibrationError
from dexsim.identification.joint import PARAMETERS, JointLog, segments, simulate, with_defaults
from dexsim.identification.search import CHI2, Search
from dexsim.identification.uncertainty import groups, uncertainty

MIN_SAMPLES = 200
MIN_MOTION = 0.02
"""rad that the joint must have moved."""

MODEL = (
    "the intervals hold for a joint that obeys this model at this time step; on C MuJoCo's joint at steps of 0.5 ms "
    "gains came out 2 % low, Coulomb friction 6 % high and viscous friction 12 % low"
)
"""Note of every identification."""

_GROUP = "the data do not separate or do not show {}: docs/calibration.md says what to record"

FIT = ("stiffness", "damping", "coulomb_friction", "viscous_friction", "stall_torque")
"""What is fitted by default, apart from latency, dead-band and the angles where it rests."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Identification:
    """Fitted parameters of one joint, and how far to trust them."""

    joint: str
    values: dict[str, float]
    """Every parameter of the model, fitted or fixed."""
    fitted: tuple[str, ...]
    intervals: dict[str, tuple[float, float]]
    """95 %, of the fitted ones; infinite where the data do not tell. For a joint that obeys this model at this time
    step: noise and what differs from signal to signal are in it, another engine's steps are not."""
    correlation: np.ndarray
    """[P, P], in the order of `fitted`; NaN for what the data do not tell."""
    condition: float
    """Condition number of the Jacobian, each column for a relative change of its parameter."""
    latency: int
    """Sub-steps."""
    latency_cost: dict[int, float]
    """Sum of squares over that of the best, less one, at each latency tried."""
    latency_plausible: tuple[int, ...]
    """Latencies that the data do not exclude."""
    timestep: float
    """s, of a sub-step."""
    unidentifiable: tuple[tuple[str, ...], ...]
    """Groups of which only a combination is known; alone: no effect on these data, or next to
    none."""
    at_bound: tuple[str, ...]
    rmse: float
    """rad, of the angles fitted to."""
    torque_rmse: float
    """Nm; NaN without torques."""
    holdout_rmse: float
    """rad, on a log that was not fitted to; NaN without one."""
    holdout_rmse_before: float
    """rad, on the same log with the values that the search began with."""
    notes: tuple[str, ...]

    def report(self) -> str:
        """A table for people."""
        rows = [
            f"{self.joint}: rmse {1e3 * self.rmse:.2f} mrad, hold-out "
            f"{1e3 * self.holdout_rmse:.2f} mrad (before {1e3 * self.holdout_rmse_before:.2f})",
            f"{'parameter':18}{'value':>12}{'95 % from':>12}{'to':>12}  unit",
        ]
        for name in self.fitted:
            low, high = self.intervals[name]
            mark = " at its bound" if name in self.at_bound else ""
            rows.append(f"{name:18}{self.values[name]:12.5g}{low:12.5g}{high:12.5g}  {PARAMETERS[name].unit}{mark}")
        others = ", ".join(str(lag) for lag in self.latency_plausible if lag != self.latency)
        rows.append(
            f"{'latency':18}{self.latency:12d} sub-steps of {1e3 * self.timestep:g} ms"
            + (f" (not excluded: {others})" if others else "")
        )
        return "\n".join(rows + [f"note: {note}" for note in self.notes])


def identify(
    log: JointLog,
    start: Mapping[str, float],
    *,
    fit: tuple[str, ...] = FIT,
    substeps: int = 3,
    latencies: tuple[int, ...] = tuple(range(9)),
    dead_band: tuple[float, float] | None = (0.0, 0.03),
    holdout: JointLog | None = None,
) -> Identification:
    """Fit one joint.

    Args:
      log: the recording; the joint rests at its beginning.
      start: first guesses and fixed values, by name in `joint.PARAMETERS`.
      fit: smooth parameters to fit; the start angles of the segments are always fitted.
      substeps: sub-steps of the simulation in a sample; period / substeps should be the time
        step that the parameters will be used with.
      latencies: candidates, sub-steps; one of them alone fixes it.
      dead_band: range to search, rad, or None to keep the value in `start`.
      holdout: another recording with the same period, best with other signals, to test on.

    Raises:
      CalibrationError: says what is wrong with the log or what to record.
    """
    for recording in (log,) if holdout is None else (log, holdout):
        check_log(recording)
    search = Search(log, start, fit, substeps, dead_band)
    search.run(latencies)
    latency, theta, count = search.latency, search.theta, search.count
    fitted = search.names[:count]
    residual = search.residual(theta, search.starts)
    intervals, correlation, condition, unidentifiable = _intervals(search, residual)
    values = {name: float(value) for name, value in search.fixed.items()}
    first = dict(values)
    values |= dict(zip(search.names, map(float, theta), strict=True))
    values["start"] = float(search.starts[0])
    margin = 1e-3 * _size(search)
    at_low, at_high = theta[:count] <= search.low[:count] + margin, theta[:count] >= search.high[:count] - margin
    at_bound = tuple(name for name, hit in zip(fitted, at_low | at_high, strict=True) if hit)
    # All from the solution and with the weights found last: costs under other weights cannot be compared.
    cost = {}
    for search.latency in sorted(latencies):
        cost[search.latency] = search.solve(theta, 10)[0]
    least = min(cost.values())
    slack = CHI2 / max(residual.size - count, 1)
    plausible = tuple(lag for lag in cost if cost[lag] <= least * (1 + slack))
    before = after = float("nan")
    if holdout is not None:
        before, _ = evaluate(holdout, first, latency=latency, substeps=substeps)
        after, _ = evaluate(holdout, values, latency=latency, substeps=substeps)
    rmse = np.sqrt(np.mean((residual.reshape(search.measured.shape) * search.noise[:, None]) ** 2, -1))
    notes = [MODEL, *(_GROUP.format(", ".join(group)) for group in unidentifiable)]
    notes += [f"{name} ran into its bound: its interval is one-sided" for name in at_bound]
    notes += _notes(log, latency, latencies, plausible, before, after)
    return Identification(
        joint=log.name,
        values=values,
        fitted=fitted,
        intervals=intervals,
        correlation=correlation,
        condition=condition,
        latency=latency,
        latency_cost={lag: cost[lag] / least - 1.0 for lag in cost},
        latency_plausible=plausible,
        timestep=search.timestep,
        unidentifiable=unidentifiable,
        at_bound=at_bound,
        rmse=float(rmse[0]),
        torque_rmse=float(rmse[1]) if len(rmse) > 1 else float("nan"),
        holdout_rmse=after,
        holdout_rmse_before=before,
        notes=tuple(notes),
    )


def _size(search: Search) -> np.ndarray:
    """What counts as a relative change of 1 of each fitted parameter."""
    return np.maximum(np.abs(search.theta), search.typical)[: search.count]


def _intervals(
    search: Search, residual: np.ndarray
) -> tuple[dict[str, tuple[float, float]], np.ndarray, float, tuple[tuple[str, ...], ...]]:
    """Intervals and correlation [P, P] of the fitted parameters, condition number, and groups that are not separated.

    From the curvature at the best point, widened by what was seen to fit as well farther off.
    """
    theta, count, size = search.theta[: search.count], search.count, _size(search)
    jacobian = search.jacobian(search.theta, search.starts)
    columns = np.r_[np.arange(count), np.arange(len(search.theta), jacobian.shape[1])]
    sizes = np.append(size, np.full(len(search.starts), 0.05))
    half, correlation, condition, null = uncertainty(jacobian[:, columns], residual, sizes, search.segment)
    half, correlation = half[:count], correlation[:count, :count]
    null = [members[:count] for members in null if np.any(members[:count])]
    least, largest = search.plausible()
    low = np.maximum(np.minimum(theta - half, least[:count]), search.low[:count])
    high = np.minimum(np.maximum(theta + half, largest[:count]), search.high[:count])
    if search.dead_band is not None:
        first, last = search.dead_band_profile(search.dead_band)
        low[-1], high[-1] = min(first, low[-1]), max(last, high[-1])
    fitted = search.names[:count]
    intervals = {name: (float(a), float(b)) for name, a, b in zip(fitted, low, high, strict=True)}
    return intervals, correlation, condition, groups(fitted, null, correlation, half, size)


def _notes(
    log: JointLog, latency: int, latencies: tuple[int, ...], plausible: tuple[int, ...], before: float, after: float
) -> list[str]:
    notes = []
    if len(latencies) > 1 and latency == max(latencies):
        notes.append("latency is the largest that was tried: try more")
    if latency not in plausible:
        others = ", ".join(map(str, plausible))
        notes.append(f"latency {others} fits better with the weights found last: identify again with it alone")
    speed = np.gradient(log.position)
    if min(np.mean(speed > 0), np.mean(speed < 0)) < 0.1:
        notes.append("the joint went one way only: friction and offsets are not apart")
    if np.isfinite(after) and after > 0.9 * before:
        notes.append(
            f"hold-out error hardly fell ({1e3 * before:.2f} to {1e3 * after:.2f} mrad): the fit is of little use"
        )
    return notes


def evaluate(log: JointLog, values: Mapping[str, float], *, latency: int, substeps: int) -> tuple[float, float]:
    """Root mean square errors of the angle, rad, and of the torque, Nm (NaN without), on a log.

    Where the joint rests, the simulation begins anew from the angle in the log (`segments`).
    """
    segment, angle = segments(log)
    full = with_defaults(dict(values), log)
    full["start"] = jnp.asarray(angle[segment], jnp.float32) - full["encoder_bias"]
    timestep, target = jnp.float32(log.period / substeps), jnp.asarray(log.target, jnp.float32)
    position, torque = simulate(full, target, jnp.int32(latency), timestep, substeps, segment)
    measured = np.nan if log.torque is None else log.torque
    angle_error, torque_error = np.asarray(position, float) - log.position, np.asarray(torque, float) - measured
    return float(np.sqrt(np.mean(angle_error**2))), float(np.sqrt(np.mean(torque_error**2)))


def check_log(log: JointLog) -> None:
    """Refuse a log that cannot tell.

    Raises:
      CalibrationError: too short, not numbers, another unit, no motion, saturated throughout.
    """
    channels = [log.target, log.position] + ([] if log.torque is None else [log.torque])
    shapes = [np.shape(channel) for channel in channels]
    if len(set(shapes)) > 1 or len(shapes[0]) != 1 or shapes[0][0] < MIN_SAMPLES:
        raise CalibrationError(
            f"{log.name}: got {', '.join(map(str, shapes))}; expected arrays of one length, at least {MIN_SAMPLES} "
            "samples of chirp, steps, slow triangles and small reversals"
        )
    if not np.all(np.isfinite(channels)):
        raise CalibrationError(
            f"{log.name}: a sample is not a number: cut the log there, samples must follow each other without gaps"
        )
    if not 1e-4 <= log.period <= 0.2:
        raise CalibrationError(f"{log.name}: period of {log.period:g} s: give seconds, from 0.0001 to 0.2")
    largest = max(np.abs(log.position).max(), np.abs(log.target).max())
    if largest > 2 * np.pi:
        raise CalibrationError(f"{log.name}: angles of {largest:.3g}: give rad, not degrees or counts")
    moved, commanded = np.ptp(log.position), np.ptp(log.target)
    if min(moved, commanded) < MIN_MOTION or not 1 / 20 < moved / commanded < 20:
        raise CalibrationError(
            f"{log.name}: commanded over {commanded:.3g} rad, moved over {moved:.3g} rad: at least {MIN_MOTION} rad of "
            "motion is needed, target and position in the same unit"
        )
    size = np.zeros(1) if log.torque is None else np.abs(log.torque)
    if size.max() > 50.0:
        raise CalibrationError(f"{log.name}: torque of {size.max():.3g} Nm: give Nm")
    if log.torque is not None and np.mean(size > 0.97 * size.max()) > 0.6:
        raise CalibrationError(
            f"{log.name}: torque sits at {size.max():.3g} Nm in most samples: saturated, give smaller commands"
        )
