"""System identification: actuator parameters from commanded and measured joint positions.

Output error: the joint is simulated from the commands alone (`dexsim.identification.joint`), and the parameters are
moved until its readings are the log's (`dexsim.identification.search`).
"""

import dataclasses
from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np
from scipy.special import stdtrit

from dexsim.calibration.line import LEAST_PRESSES
from dexsim.calibration.signals import check_signals
from dexsim.core.errors import CalibrationError
from dexsim.identification.joint import PARAMETERS, JointLog, segments, simulate, with_defaults
from dexsim.identification.search import CHI2, Search

MIN_SAMPLES = 200
MIN_MOTION = 0.02
"""rad that the joint must have moved."""

_SATURATED = 0.6, 0.97  # share of the samples that may have this share of the largest torque
_PARTS = 20  # equal stretches of a log
_NULL = 1e-4  # singular values below this share of the largest are none: the Jacobian is float32
_CORRELATED, _VAGUE = 0.97, 0.5
_NORMAL = 1.96  # 97.5 % quantile
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
    """95 %, of the fitted ones; infinite where the data do not tell. Noise and what differs from signal to signal are
    in it, another engine's steps are not."""
    latency: int
    """Sub-steps."""
    latency_plausible: tuple[int, ...]
    """Latencies that the data do not exclude."""
    timestep: float
    """s, of a sub-step."""
    unidentifiable: tuple[tuple[str, ...], ...]
    """Groups of which only a combination is known; alone: next to no effect on these data."""
    at_bound: tuple[str, ...]
    rmse: float
    """rad, of the angles fitted to."""
    holdout_rmse: float
    """rad, on a log that was not fitted to; NaN without one."""
    holdout_rmse_before: float
    """rad, on the same log with the values that the search began with."""
    notes: tuple[str, ...]

    def report(self) -> str:
        """A table for people."""
        rmse, after, before = (1e3 * error for error in (self.rmse, self.holdout_rmse, self.holdout_rmse_before))
        rows = [
            f"{self.joint}: rmse {rmse:.2f} mrad, hold-out {after:.2f} mrad (before {before:.2f})",
            f"{'parameter':18}{'value':>12}{'95 % from':>12}{'to':>12}  unit",
        ]
        for name in self.fitted:
            low, high = self.intervals[name]
            mark = " at its bound" if name in self.at_bound else ""
            rows.append(f"{name:18}{self.values[name]:12.5g}{low:12.5g}{high:12.5g}  {PARAMETERS[name].unit}{mark}")
        others = ", ".join(str(lag) for lag in self.latency_plausible if lag != self.latency)
        mark = f" (not excluded: {others})" if others else ""
        rows.append(f"{'latency':18}{self.latency:12d} sub-steps of {1e3 * self.timestep:g} ms{mark}")
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
    latency, count = search.latency, search.count
    fitted = search.names[:count]
    theta, low, high = (part[:count] for part in (search.theta, search.low, search.high))
    residual = search.residual(search.theta, search.starts)
    rmse = search.noise[0] * np.sqrt(np.mean(residual[: len(log.position)] ** 2))
    first = {name: float(value) for name, value in search.fixed.items()}
    values = first | dict(zip(search.names, search.theta.tolist(), strict=True)) | {"start": float(search.starts[0])}
    size = np.maximum(np.abs(theta), search.typical[:count])  # what counts as a relative change of 1
    jacobian = search.jacobian(search.theta, search.starts)
    columns = np.r_[np.arange(count), np.arange(len(search.theta), jacobian.shape[1])]
    sizes = np.append(size, np.full(len(search.starts), 0.05))
    half, correlation, null = uncertainty(jacobian[:, columns], residual, sizes, search.segment)
    half, correlation = half[:count], correlation[:count, :count]
    least, largest = (part[:count] for part in search.plausible())
    if dead_band is not None:
        ends = search.dead_band_profile(dead_band)
        least[-1], largest[-1] = min(ends[0], least[-1]), max(ends[1], largest[-1])
    # What was seen to fit as well farther off widens what the curvature says.
    least, largest = np.minimum(theta - half, least).clip(low), np.maximum(theta + half, largest).clip(None, high)
    vague = np.maximum(half, (largest - least) / 2) > _NORMAL * _VAGUE * size
    unidentifiable = _groups(fitted, [members[:count] for members in null], correlation, vague)
    margin = 1e-3 * size
    at_bound = tuple(np.array(fitted)[(theta <= low + margin) | (theta >= high - margin)].tolist())
    # All from the solution and with the weights found last: costs under other weights cannot be compared.
    cost = {}
    for search.latency in sorted(latencies):
        cost[search.latency] = search.solve(search.theta, 10)[0]
    limit = min(cost.values()) * (1 + CHI2 / max(residual.size - count, 1))
    plausible = tuple(lag for lag in cost if cost[lag] <= limit)
    before = after = float("nan")
    if holdout is not None:
        before, after = (evaluate(holdout, v, latency=latency, substeps=substeps) for v in (first, values))
    notes = [_GROUP.format(", ".join(group)) for group in unidentifiable]
    notes += [f"{name} ran into its bound: its interval is one-sided" for name in at_bound]
    if len(latencies) > 1 and latency == max(latencies):
        notes.append("latency is the largest that was tried: try more")
    if latency not in plausible:
        others = ", ".join(map(str, plausible))
        notes.append(f"latency {others} fits better with the weights found last: identify again with it alone")
    speed = np.gradient(log.position)
    if min(np.mean(speed > 0), np.mean(speed < 0)) < 0.1:
        notes.append("the joint went one way only: friction and offsets are not apart")
    if after > 0.9 * before:
        errors = f"{1e3 * before:.2f} to {1e3 * after:.2f} mrad"
        notes.append(f"hold-out error hardly fell ({errors}): the fit is of little use")
    return Identification(
        joint=log.name,
        values=values,
        fitted=fitted,
        intervals={name: (float(a), float(b)) for name, a, b in zip(fitted, least, largest, strict=True)},
        latency=latency,
        latency_plausible=plausible,
        timestep=search.timestep,
        unidentifiable=unidentifiable,
        at_bound=at_bound,
        rmse=float(rmse),
        holdout_rmse=after,
        holdout_rmse_before=before,
        notes=tuple(notes),
    )


def _groups(
    names: tuple[str, ...], null: list[np.ndarray], correlation: np.ndarray, vague: np.ndarray
) -> tuple[tuple[str, ...], ...]:
    """Groups of parameters that the data do not separate, or see."""
    sets = [tuple(n for n, m in zip(names, members, strict=True) if m) for members in null]
    inside = {name for group in sets for name in group}
    for i in np.flatnonzero(vague):
        mates = np.abs(correlation[i]) > _CORRELATED  # It is one of them.
        sets.append(() if names[i] in inside else tuple(n for n, m in zip(names, mates, strict=True) if m))
    return tuple(dict.fromkeys(group for group in sets if group))


def uncertainty(
    jacobian: np.ndarray, residual: np.ndarray, size: np.ndarray, segment: np.ndarray
) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
    """Half-widths and correlations from a least-squares solution.

    The widest of three intervals counts: that of independent residuals, and those of residuals that go together in the
    segments, and in equal stretches of time. What the model gets wrong differs from signal to signal, and residuals
    that follow each other go together.

    Args:
      jacobian: [N, P] of the weighted residuals [N], N a multiple of the instants T (channels).
      size: [P], what counts as a relative change of 1.
      segment: [T] int, parts of the log that began at rest.

    Returns:
      Half of the 95 % intervals [P] (infinite for members of null directions), correlation [P, P], and the null
      directions [P] as boolean masks of their members.
    """
    left, singular, right = np.linalg.svd(jacobian * size, full_matrices=False)
    determined = singular > _NULL * singular[0]
    null = [np.abs(v) > 0.15 * np.max(np.abs(v)) for v in right[~determined]]
    basis, solution = left[:, determined], right[determined].T / singular[determined]  # [N, D], [P, D]
    covariance = solution @ solution.T * np.sum(residual**2) / max(len(residual) - len(size), 1)
    spread = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    half = _NORMAL * spread
    for group in (segment, np.arange(len(segment)) * _PARTS // len(segment)):
        own = np.tile(group, len(residual) // len(group)) == np.unique(group)[:, None]
        if len(own) >= LEAST_PRESSES:
            moved = np.array([_influence(basis[rows], residual[rows]) for rows in own]) @ solution.T
            half = np.maximum(half, stdtrit(len(own) - 1, 0.975) * np.linalg.norm(moved, axis=0))
    half = half * size
    correlation = covariance / np.outer(spread, spread)
    for members in null:
        half[members] = np.inf
        correlation[members], correlation[:, members] = np.nan, np.nan
    return half, correlation, null


def _influence(basis: np.ndarray, residual: np.ndarray) -> np.ndarray:
    """How a group of residuals [n] moves a fit [D], by its rows [n, D] of the orthonormal basis of all residuals.

    A fit follows the group that shows a parameter best, which makes that group's residuals too small. The root of the
    share that other groups have in each direction corrects this (CR2 of Bell and McCaffrey 2002). A jackknife divides
    by the share itself, and explodes where one group has nearly all of it: the place of a dead-band's edge, say.
    """
    share, axes = np.linalg.eigh(basis.T @ basis)
    weight = np.where(share < 1 - 1e-6, 1 / np.sqrt(np.maximum(1 - share, 1e-6)), 0.0)  # 1: a start of its own
    return axes @ (weight * (axes.T @ (basis.T @ residual)))


def evaluate(log: JointLog, values: Mapping[str, float], *, latency: int, substeps: int) -> float:
    """Root mean square error rad of the angle on a log.

    Where the joint rests, the simulation begins anew from the angle in the log (`segments`).
    """
    segment, angle = segments(log)
    full = with_defaults(dict(values), log)
    full["start"] = jnp.asarray(angle[segment], jnp.float32) - full["encoder_bias"]
    timestep, target = jnp.float32(log.period / substeps), jnp.asarray(log.target, jnp.float32)
    position, _ = simulate(full, target, jnp.int32(latency), timestep, substeps, segment)
    return float(np.sqrt(np.mean((np.asarray(position, float) - log.position) ** 2)))


def check_log(log: JointLog) -> None:
    """Refuse a log that cannot tell.

    Raises:
      CalibrationError: too short, not numbers, another unit, no motion, saturated throughout.
    """
    channels = {"target": (log.target, "rad"), "position": (log.position, "rad")}
    if log.torque is not None:
        channels["torque"] = log.torque, "Nm"
    check_signals(log.name, MIN_SAMPLES, channels, *_SATURATED)
    if not 1e-4 <= log.period <= 0.2:
        raise CalibrationError(f"{log.name}: period of {log.period:g} s: give seconds, from 0.0001 to 0.2")
    moved, commanded = np.ptp(log.position), np.ptp(log.target)
    if min(moved, commanded) < MIN_MOTION or not commanded / 20 < moved < 20 * commanded:
        raise CalibrationError(
            f"{log.name}: commanded over {commanded:.3g} rad, moved over {moved:.3g} rad: at least {MIN_MOTION} rad of "
            "motion is needed, target and position in the same unit"
        )
