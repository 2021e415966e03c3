"""System identification: actuator parameters from commanded and measured joint positions.

Output error: the joint is simulated from the commands alone (`dexsim.identification.joint`), and the parameters are
moved until its readings are the log's (`dexsim.identification.search`).
"""

import dataclasses
from collections.abc import Mapping

import numpy as np
from scipy.special import stdtrit

from dexsim.core.errors import CalibrationError
from dexsim.identification.joint import PARAMETERS, JointLog
from dexsim.identification.search import CHI2, Search

_LEAST_GROUPS = 3  # segments below which their differences are not part of an interval

MIN_SAMPLES = 200
MIN_MOTION = 0.02
"""rad that the joint must have moved."""

MODEL = (
    "the intervals hold for a joint that obeys this model at this time step; on C MuJoCo's joint at steps of 0.5 ms "
    "gains came out 2 % low, Coulomb friction 6 % high and viscous friction 12 % low"
)
"""Note of every identification."""

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
    correlation: np.ndarray
    """[P, P], in the order of `fitted`; NaN for what the data do not tell."""
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
    torque_rmse: float
    """Nm; NaN without torques."""
    notes: tuple[str, ...]

    def report(self) -> str:
        """A table for people."""
        rows = [
            f"{self.joint}: rmse {1e3 * self.rmse:.2f} mrad",
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

    Raises:
      CalibrationError: says what is wrong with the log or what to record.
    """
    check_log(log)
    search = Search(log, start, fit, substeps, dead_band)
    search.run(latencies)
    latency, theta, count = search.latency, search.theta, search.count
    fitted = search.names[:count]
    residual = search.residual(theta, search.starts)
    intervals, correlation, unidentifiable = _intervals(search, residual)
    values = {name: float(value) for name, value in search.fixed.items()}
    values |= dict(zip(search.names, map(float, theta), strict=True)) | {"start": float(search.starts[0])}
    margin = 1e-3 * _size(search)
    at_low, at_high = theta[:count] <= search.low[:count] + margin, theta[:count] >= search.high[:count] - margin
    at_bound = tuple(name for name, hit in zip(fitted, at_low | at_high, strict=True) if hit)
    # All from the solution and with the weights found last: costs under other weights cannot be compared.
    cost = {}
    for search.latency in sorted(latencies):
        cost[search.latency] = search.solve(theta, 10)[0]
    limit = min(cost.values()) * (1 + CHI2 / max(residual.size - count, 1))
    plausible = tuple(lag for lag in cost if cost[lag] <= limit)
    rmse = np.sqrt(np.mean((residual.reshape(search.measured.shape) * search.noise[:, None]) ** 2, -1))
    notes = [MODEL, *(_GROUP.format(", ".join(group)) for group in unidentifiable)]
    notes += [f"{name} ran into its bound: its interval is one-sided" for name in at_bound]
    if len(latencies) > 1 and latency == max(latencies):
        notes.append("latency is the largest that was tried: try more")
    if latency not in plausible:
        others = ", ".join(map(str, plausible))
        notes.append(f"latency {others} fits better with the weights found last: identify again with it alone")
    speed = np.gradient(log.position)
    if min(np.mean(speed > 0), np.mean(speed < 0)) < 0.1:
        notes.append("the joint went one way only: friction and offsets are not apart")
    return Identification(
        joint=log.name,
        values=values,
        fitted=fitted,
        intervals=intervals,
        correlation=correlation,
        latency=latency,
        latency_plausible=plausible,
        timestep=search.timestep,
        unidentifiable=unidentifiable,
        at_bound=at_bound,
        rmse=float(rmse[0]),
        torque_rmse=float(rmse[1]) if len(rmse) > 1 else float("nan"),
        notes=tuple(notes),
    )


def _size(search: Search) -> np.ndarray:
    """What counts as a relative change of 1 of each fitted parameter."""
    return np.maximum(np.abs(search.theta), search.typical)[: search.count]


def _intervals(
    search: Search, residual: np.ndarray
) -> tuple[dict[str, tuple[float, float]], np.ndarray, tuple[tuple[str, ...], ...]]:
    """Intervals and correlation [P, P] of the fitted parameters, and groups that are not separated.

    From the curvature at the best point, widened by what was seen to fit as well farther off.
    """
    theta, count, size = search.theta[: search.count], search.count, _size(search)
    jacobian = search.jacobian(search.theta, search.starts)
    columns = np.r_[np.arange(count), np.arange(len(search.theta), jacobian.shape[1])]
    sizes = np.append(size, np.full(len(search.starts), 0.05))
    half, correlation, null = uncertainty(jacobian[:, columns], residual, sizes, search.segment)
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
    return intervals, correlation, _groups(fitted, null, correlation, half, size)


def uncertainty(
    jacobian: np.ndarray, residual: np.ndarray, size: np.ndarray, segment: np.ndarray
) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
    """Half-widths and correlations from a least-squares solution.

    Args:
      jacobian: [N, P] of the weighted residuals [N], N a multiple of the instants T (channels).
      size: [P], what counts as a relative change of 1.
      segment: [T] int, parts of the log that began at rest; residuals of one part belong together.

    Returns:
      Half of the 95 % intervals [P] (infinite for members of null directions), correlation [P, P], and the null
      directions [P] as boolean masks of their members.
    """
    relative = jacobian * size
    _, singular, right = np.linalg.svd(relative, full_matrices=False)
    determined = singular > _NULL * singular[0]
    null = [np.abs(v) > 0.15 * np.max(np.abs(v)) for v in right[~determined]]
    inverse = (right[determined].T / singular[determined] ** 2) @ right[determined]
    freedom = max(len(residual) - len(size), 1)
    white = inverse * np.sum(residual**2) / freedom
    score = (relative * residual[:, None]).reshape(-1, len(segment), len(size)).sum(0)
    robust = inverse @ _long_run(score) @ inverse * len(residual) / freedom
    # Whichever is larger: the robust one is itself a guess and falls short in half of all cases.
    half = _NORMAL * np.sqrt(np.maximum(np.diag(white), np.diag(robust)))
    half = np.maximum(half, _between_segments(relative, score, segment)) * size
    spread = np.sqrt(np.maximum(np.diag(white), 1e-300))
    correlation = white / np.outer(spread, spread)
    for members in null:
        half[members] = np.inf
        correlation[members], correlation[:, members] = np.nan, np.nan
    return half, correlation, null


def _between_segments(relative: np.ndarray, score: np.ndarray, segment: np.ndarray) -> np.ndarray:
    """Half of the 95 % intervals [P] by the jackknife over segments, one Newton step each.

    What the model gets wrong differs from signal to signal, which no autocorrelation shows.
    """
    rows = relative.reshape(-1, len(segment), relative.shape[1])
    parts = [np.einsum("ctp,ctq->pq", rows[:, segment == k], rows[:, segment == k]) for k in np.unique(segment)]
    count, whole = len(parts), np.sum(parts, 0)
    if count < _LEAST_GROUPS:
        return np.zeros(len(whole))
    scores = [score[segment == k].sum(0) for k in np.unique(segment)]
    moved = [
        np.linalg.pinv(whole - part, rcond=_NULL**2, hermitian=True) @ own
        for part, own in zip(parts, scores, strict=True)
    ]
    return stdtrit(count - 1, 0.975) * np.sqrt((count - 1) / count * np.sum(np.square(moved), 0))


def _groups(
    names: tuple[str, ...], null: list[np.ndarray], correlation: np.ndarray, half: np.ndarray, size: np.ndarray
) -> tuple[tuple[str, ...], ...]:
    """Which parameters the data do not separate, or do not see."""
    sets = [tuple(n for n, m in zip(names, members, strict=True) if m) for members in null]
    inside = {name for group in sets for name in group}
    for i, first in enumerate(names):
        if first in inside:
            continue
        mates = [j for j in range(len(names)) if j != i and abs(correlation[i, j]) > _CORRELATED]
        vague = half[i] > _NORMAL * _VAGUE * size[i]
        if vague and mates:
            sets.append(tuple(sorted({first, *(names[j] for j in mates)}, key=names.index)))
        elif vague:
            sets.append((first,))
    return tuple(dict.fromkeys(sets))


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
    target, position = log.target, log.position
    moved, commanded = np.ptp(position), np.ptp(target)
    largest = np.max(np.abs([target, position]))
    torque = np.zeros(1) if log.torque is None else np.abs(log.torque)
    strongest = torque.max()
    for wrong, says in (
        (
            not np.all(np.isfinite(channels)),
            "a sample is not a number: cut the log there, samples must follow each other without gaps",
        ),
        (not 1e-4 <= log.period <= 0.2, f"period of {log.period:g} s: give seconds, from 0.0001 to 0.2"),
        (largest > 2 * np.pi, f"angles of {largest:.3g}: give rad, not degrees or counts"),
        (
            min(moved, commanded) < MIN_MOTION or not commanded / 20 < moved < 20 * commanded,
            f"commanded over {commanded:.3g} rad, moved over {moved:.3g} rad: at least {MIN_MOTION} rad of motion is "
            "needed, target and position in the same unit",
        ),
        (strongest > 50.0, f"torque of {strongest:.3g} Nm: give Nm"),
        (
            strongest > 0 and np.mean(torque > 0.97 * strongest) > 0.6,
            f"torque sits at {strongest:.3g} Nm in most samples: saturated, give smaller commands",
        ),
    ):
        if wrong:
            raise CalibrationError(f"{log.name}: {says}")


def _long_run(score: np.ndarray) -> np.ndarray:
    """Sum [P, P] of the autocovariances of a zero-mean series `score` [T, P], times T: Newey-West on the series without
    its first-order autoregression (Andrews and Monahan 1992), bandwidth after Andrews 1991."""
    count = len(score)
    rho = _autocorrelation(score)
    white = score[1:] - rho * score[:-1]
    left = _autocorrelation(white)
    alpha = float(np.max(4 * left**2 / ((1 - left) * (1 + left)) ** 2))
    lags = min(int(1.1447 * (alpha * count) ** (1 / 3)) + 1, count // 4)
    total = white.T @ white
    for lag in range(1, lags + 1):
        cross = white[lag:].T @ white[:-lag]
        total += (1.0 - lag / (lags + 1)) * (cross + cross.T)
    return total / np.outer(1.0 - rho, 1.0 - rho) * count / (count - 1)


def _autocorrelation(series: np.ndarray) -> np.ndarray:
    """First-order coefficient [P] of each column, corrected for its bias in short series. Correlation over more than a
    quarter of the series is not to be told from a trend."""
    rho = np.sum(series[:-1] * series[1:], 0) / np.maximum(np.sum(series**2, 0), 1e-300)
    return np.clip(rho + (1.0 + 3.0 * rho) / len(series), -0.5, min(0.97, 1.0 - 4.0 / len(series)))
