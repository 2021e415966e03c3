"""System identification: actuator parameters from commanded and measured joint positions.

Output error: the joint is simulated from the commands alone (`dexsim.identification.joint`), and the
parameters are moved until its readings are the log's. Smooth parameters go by the gradient through
the jitted simulation; latency is a whole number and the dead-band a threshold, so they are
searched outside of it (`dexsim.identification.search`).
"""

from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np

from dexsim.core.errors import CalibrationError
from dexsim.identification.joint import JointLog, segments, simulate, with_defaults
from dexsim.identification.report import TYPICAL, Identification, advice, groups, uncertainty
from dexsim.identification.search import BOUNDS, CHI2, Problem

MIN_SAMPLES = 200
MIN_MOTION = 0.02
"""rad that the joint must have moved."""

MODEL = (
    "the intervals hold for a joint that obeys this model at this time step; on C MuJoCo's joint at steps of 0.5 ms "
    "gains came out 2 % low, Coulomb friction 6 % high and viscous friction 12 % low"
)
"""Note of every identification."""

FIT = ("stiffness", "damping", "coulomb_friction", "viscous_friction", "stall_torque")
"""What is fitted by default, apart from latency, dead-band and the angles where it rests."""


def identify(
    log: JointLog,
    start: Mapping[str, float],
    *,
    fit: tuple[str, ...] = FIT,
    substeps: int = 3,
    latencies: tuple[int, ...] = tuple(range(9)),
    dead_band: tuple[float, float] | None = (0.0, 0.03),
    bounds: Mapping[str, tuple[float, float]] | None = None,
    position_noise: float = 0.002,
    torque_noise: float = 0.02,
    holdout: JointLog | None = None,
) -> Identification:
    """Fit one joint.

    Args:
      log: the recording; the joint rests at its beginning.
      start: first guesses and fixed values, by name in `joint_model.PARAMETERS`.
      fit: smooth parameters to fit; the start angles of the segments are always fitted.
      substeps: sub-steps of the simulation in a sample; period / substeps should be the time
        step that the parameters will be used with.
      latencies: candidates, sub-steps; one of them alone fixes it.
      dead_band: range to search, rad, or None to keep the value in `start`.
      bounds: by name, in place of `BOUNDS`.
      position_noise, torque_noise: rad, Nm: first weights; they are estimated from what the fit
        leaves.
      holdout: another recording, best with other signals, to test on.

    Raises:
      CalibrationError: says what is wrong with the log or what to record.
    """
    for recording in (log,) if holdout is None else (log, holdout):
        check_log(recording)
    if holdout is not None and not np.isclose(holdout.period, log.period):
        raise CalibrationError(
            f"{holdout.name}: a period of {holdout.period:g} s, that of the log to fit is {log.period:g} s: a latency "
            "in sub-steps is not the same in both"
        )
    limits = dict(BOUNDS) | {"dead_band": dead_band or (0.0, np.inf)}
    if unknown := sorted({*(bounds or {})} - {*limits}):
        raise CalibrationError(f"there are no bounds of {unknown[0]!r}: choose from {', '.join(limits)}")
    if not latencies:
        raise CalibrationError("no latencies to try: give at least one, in sub-steps")
    limits |= dict(bounds or {})
    problem = Problem(log, start, fit, substeps, limits, np.array([position_noise, torque_noise]))
    latency = problem.best_latency(latencies)
    for fine in (False, True):  # once with the given weights, once with those found
        if dead_band is not None:
            problem.search_dead_band(latency, dead_band, fine)
        latency = problem.best_latency(latencies, latency)
        problem.settle(latency, dead_band is not None, last=fine)
    return _conclude(problem, latency, latencies, dead_band, holdout)


def evaluate(log: JointLog, values: Mapping[str, float], *, latency: int, substeps: int) -> tuple[float, float]:
    """Root mean square errors of the angle, rad, and of the torque, Nm (NaN without), on a log.

    Where the joint rests, the simulation begins anew from the angle in the log (`segments`).
    """
    segment, angle = segments(log)
    full = with_defaults(dict(values), log)
    full["start"] = jnp.asarray(angle[segment], jnp.float32) - full["encoder_bias"]
    readings = simulate(
        full,
        jnp.asarray(log.target, jnp.float32),
        jnp.int32(latency),
        jnp.float32(log.period / substeps),
        substeps,
        segment,
    )
    measured = (log.position, np.nan if log.torque is None else log.torque)
    angle_off, torque_off = (
        float(np.sqrt(np.mean((np.asarray(ours, float) - theirs) ** 2)))
        for ours, theirs in zip(readings, measured, strict=True)
    )
    return angle_off, torque_off


def check_log(log: JointLog) -> None:
    """Refuse a log that cannot tell.

    Raises:
      CalibrationError: too short, not numbers, mixed units, no motion, saturated throughout.
    """
    channels = {"target": log.target, "position": log.position} | ({} if log.torque is None else {"torque": log.torque})
    for name, values in channels.items():
        if np.shape(values) != np.shape(log.target) or np.ndim(values) != 1:
            raise CalibrationError(
                f"{log.name}: {name} has shape {np.shape(values)}, target "
                f"{np.shape(log.target)}: give arrays of one length"
            )
        bad = np.flatnonzero(~np.isfinite(values))
        if len(bad):
            raise CalibrationError(
                f"{log.name}: {name} is not a number at sample {bad[0]}: cut "
                "the log there, samples must follow each other without gaps"
            )
    if len(log.target) < MIN_SAMPLES:
        raise CalibrationError(
            f"{log.name}: {len(log.target)} samples: at least {MIN_SAMPLES} of "
            "chirp, steps, slow triangles and small reversals are needed"
        )
    if not 1e-4 <= log.period <= 0.2:
        raise CalibrationError(f"{log.name}: period of {log.period:g} s: give seconds, from 0.0001 to 0.2")
    moved, asked = np.ptp(log.position), np.ptp(log.target)
    if max(np.abs(log.position).max(), np.abs(log.target).max()) > 2 * np.pi:
        raise CalibrationError(
            f"{log.name}: angles of {np.abs(log.position).max():.3g}: give rad, not degrees or counts"
        )
    if min(asked, moved) > 1e-3 and not 1 / 20 < moved / asked < 20:
        raise CalibrationError(
            f"{log.name}: commanded over {asked:.3g} rad, moved over {moved:.3g} "
            "rad: target and position are in different units"
        )
    if asked < MIN_MOTION or moved < MIN_MOTION:
        raise CalibrationError(
            f"{log.name}: commanded over {asked:.3g} rad, moved over {moved:.3g} "
            f"rad: at least {MIN_MOTION} rad of motion is needed"
        )
    if log.torque is not None:
        size = np.abs(log.torque)
        if size.max() > 50.0:
            raise CalibrationError(f"{log.name}: torque of {size.max():.3g} Nm: give Nm")
        if np.mean(size > 0.97 * size.max()) > 0.6:
            raise CalibrationError(
                f"{log.name}: torque sits at {size.max():.3g} Nm in most "
                "samples: saturated, give smaller or slower commands"
            )


def _conclude(
    problem: Problem,
    latency: int,
    latencies: tuple[int, ...],
    dead_band: tuple[float, float] | None,
    holdout: JointLog | None,
) -> Identification:
    log, theta = problem.log, problem.theta
    fitted = problem.names if dead_band is not None else problem.names[:-1]
    count = len(fitted)
    residual = problem.residual(theta, problem.starts, latency)
    jacobian = problem.jacobian(theta, problem.starts, latency)
    columns = np.r_[np.arange(count), np.arange(len(theta), jacobian.shape[1])]
    size = np.maximum(np.abs(theta), [TYPICAL[name] for name in problem.names])[:count]
    half, correlation, condition, null = uncertainty(
        jacobian[:, columns], residual, np.append(size, np.full(len(problem.starts), 0.05)), problem.segment
    )
    half, correlation = half[:count], correlation[:count, :count]
    null = [members[:count] for members in null if np.any(members[:count])]
    low, high = problem.low[:count], problem.high[:count]
    # Curvature at the best point, widened by what was seen to fit as well farther off.
    least, largest = problem.plausible(latency, dead_band is not None)
    ends = np.stack(
        [
            np.maximum(np.minimum(theta[:count] - half, least[:count]), low),
            np.minimum(np.maximum(theta[:count] + half, largest[:count]), high),
        ],
        -1,
    )
    intervals = {name: (float(a), float(b)) for name, (a, b) in zip(fitted, ends, strict=True)}
    if dead_band is not None:
        profile = problem.dead_band_profile(latency, dead_band)
        linear = intervals["dead_band"]
        intervals["dead_band"] = (min(profile[0], linear[0]), max(profile[1], linear[1]))
    values = {name: float(value) for name, value in problem.fixed.items()}
    values |= dict(zip(problem.names, map(float, theta), strict=True))
    values["start"] = float(problem.starts[0])
    touching = (theta[:count] <= low + 1e-3 * size) | (theta[:count] >= high - 1e-3 * size)
    at_bound = tuple(n for n, hit in zip(fitted, touching, strict=True) if hit)
    sets = groups(fitted, null, correlation, half, size)
    errors = residual.reshape(len(problem.measured), -1) * problem.noise[: len(problem.measured), None]
    rmse = np.sqrt(np.mean(errors**2, -1))
    # All from the solution and with the weights found last: costs under other weights cannot be compared.
    cost = {lag: problem.solve(theta, lag, 10)[0] for lag in latencies}
    least_cost = min(cost.values())
    slack = CHI2 / max(residual.size - count, 1)
    plausible = tuple(lag for lag in sorted(cost) if cost[lag] <= least_cost * (1 + slack))
    before = after = float("nan")
    if holdout is not None:
        first = {name: float(value) for name, value in problem.fixed.items()}
        before = evaluate(holdout, first, latency=latency, substeps=problem.substeps)[0]
        after = evaluate(holdout, values, latency=latency, substeps=problem.substeps)[0]
    return Identification(
        joint=log.name,
        values=values,
        fitted=fitted,
        intervals=intervals,
        correlation=correlation,
        condition=condition,
        latency=latency,
        latency_cost={lag: cost[lag] / least_cost - 1.0 for lag in sorted(cost)},
        latency_plausible=plausible,
        timestep=problem.timestep,
        unidentifiable=sets,
        at_bound=at_bound,
        rmse=float(rmse[0]),
        torque_rmse=float(rmse[1]) if len(rmse) > 1 else float("nan"),
        holdout_rmse=after,
        holdout_rmse_before=before,
        notes=tuple(_notes(log, latency, latencies, plausible, sets, at_bound, before, after)),
    )


def _notes(
    log: JointLog,
    latency: int,
    latencies: tuple[int, ...],
    plausible: tuple[int, ...],
    sets: tuple[tuple[str, ...], ...],
    at_bound: tuple[str, ...],
    before: float,
    after: float,
) -> list[str]:
    notes = advice(sets)
    notes.append(MODEL)
    notes += [f"{name} ran into its bound: its interval is one-sided" for name in at_bound]
    if len(latencies) > 1 and latency == max(latencies):
        notes.append("latency is the largest that was tried: try more")
    if latency not in plausible:
        others = ", ".join(map(str, plausible))
        notes.append(f"latency {others} fits better with the weights found last: identify again with it alone")
    speed = np.gradient(log.position)
    if (
        min(np.mean(speed > 0), np.mean(speed < 0)) < 0.1
        or np.all(np.diff(log.target) >= 0)
        or np.all(np.diff(log.target) <= 0)
    ):
        notes.append("the joint went one way only: friction and offsets are not apart")
    if np.isfinite(after) and after > 0.9 * before:
        notes.append(
            f"hold-out error hardly fell ({1e3 * before:.2f} to {1e3 * after:.2f} mrad): the fit is of little use"
        )
    return notes
