"""System identification: actuator parameters from commanded and measured joint positions.

Output error: the joint is simulated from the commands alone (`dexsim.identification.joint`), and the parameters are
moved until its readings are the log's.

Inner loop of this search: `scipy.optimize.least_squares` with the gradient through the jitted simulation. Outer loops
without gradient: a scan over latency (a whole number), and a cross-entropy search, as a dead-band (a threshold) makes
the cost rugged.
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import least_squares
from scipy.special import stdtrit

from dexsim.calibration.fit import LEAST_PRESSES
from dexsim.core.pytree import pytree_dataclass, static
from dexsim.errors import CalibrationError
from dexsim.identification.joint import PARAMETERS, JointLog, segments, simulate, with_defaults

_PARTS = 20  # equal stretches of a log
_NULL = 1e-4  # singular values below this share of the largest are none: the Jacobian is float32
_CORRELATED, _VAGUE = 0.97, 0.5
_NORMAL = 1.96  # 97.5 % quantile
_GROUP = "the data do not separate or do not show {}: docs/calibration.md says what to record"

_BLUR = 2e-3  # rad, width of the dead-band's edges in the gradient
_CHI2 = 3.84  # 95 %, one parameter
_THRESHOLD = 7.35  # 95 % for a threshold (Hansen 2000): the likelihood has a kink there
_NOISE = (0.002, 0.02)  # rad, Nm: weights of angle and torque to begin with

# In the order of the arrays below: whatever is fitted, the compiled programs are the same.
_NAMES = tuple(PARAMETERS)

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
      CalibrationError: a name that cannot be fitted, or a first guess out of its bounds.
    """
    search = Search(log, start, fit, substeps, dead_band)
    search.run(latencies)
    latency, fitted, count = search.latency, search.names, len(search.names)
    theta, low, high = search.theta, search.low, search.high
    residual = search.residual(theta, search.starts)
    rmse = search.noise[0] * np.sqrt(np.mean(residual[: len(log.position)] ** 2))
    first = {name: float(value) for name, value in search.fixed.items()}
    values = first | dict(zip(fitted, theta.tolist(), strict=True)) | {"start": float(search.starts[0])}
    size = np.maximum(np.abs(theta), search.typical)  # what counts as a relative change of 1
    jacobian = search.jacobian(theta, search.starts)
    sizes = np.append(size, np.full(len(search.starts), 0.05))
    half, correlation, null = uncertainty(jacobian, residual, sizes, search.segment)
    half, correlation = half[:count], correlation[:count, :count]
    # What was seen to fit as well farther off widens what the curvature says.
    least, largest = search.plausible()
    least, largest = np.minimum(theta - half, least).clip(low), np.maximum(theta + half, largest).clip(None, high)
    vague = np.maximum(half, (largest - least) / 2) > _NORMAL * _VAGUE * size
    unidentifiable = _groups(fitted, [members[:count] for members in null], correlation, vague)
    margin = 1e-3 * size
    at_bound = tuple(np.array(fitted)[(theta <= low + margin) | (theta >= high - margin)].tolist())
    # All from the solution and with the weights found last: costs under other weights cannot be compared.
    cost = {}
    for search.latency in sorted(latencies):
        cost[search.latency] = search.solve(theta, 10)[0]
    limit = min(cost.values()) * (1 + _CHI2 / max(residual.size - count, 1))
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


# --- the search -----------------------------------------------------------------------------------


@pytree_dataclass
class _Data:
    """A log on the device; C channels: the angle, and the torque if it was recorded."""

    target: jax.Array  # [T] rad
    measured: jax.Array  # [C, T] rad, Nm
    segment: jax.Array  # [T]
    timestep: jax.Array  # s
    substeps: int = static()


@functools.partial(jax.jit, static_argnames="blur")
def _readings(data: _Data, values: jax.Array, starts: jax.Array, latency: jax.Array, blur: float = 0.0) -> jax.Array:
    """[C, T] angle and torque, from all parameters and each sample's segment's start [T]."""
    named = dict(zip(_NAMES, values, strict=True)) | {"start": starts}
    out = simulate(named, data.target, latency, data.timestep, data.substeps, data.segment, blur)
    return jnp.stack(out[: len(data.measured)])


@jax.jit
def _slopes(data: _Data, values: jax.Array, starts: jax.Array, latency: jax.Array) -> jax.Array:
    """[C, T, P + 1] derivatives of `_readings` by all parameters and by the segment's start.

    The dead-band's edges are blurred: the exact gradient does not see that a parameter moves the
    instant at which the torque switches.
    """

    def blurred(values: jax.Array, shift: jax.Array) -> jax.Array:
        return _readings(data, values, starts + shift, latency, blur=_BLUR)

    by_value, by_start = jax.jacfwd(blurred, (0, 1))(values, jnp.zeros(()))
    return jnp.concatenate([by_value, by_start[..., None]], -1)


@jax.jit
def _crowd_costs(data: _Data, crowd: jax.Array, starts: jax.Array, latency: jax.Array, weight: jax.Array) -> jax.Array:
    """Weighted sums of squares [N] for parameters [N, P]."""

    def cost(values: jax.Array) -> jax.Array:
        error = _readings(data, values, starts, latency) - data.measured
        return jnp.sum((error * weight[:, None]) ** 2)

    return jax.vmap(cost)(crowd)


class Search:
    """One log's least squares: theta [P] (what is fitted, a dead-band last), the starts [S], and the latency.

    The arguments and errors are those of `identify`.
    """

    def __init__(
        self,
        log: JointLog,
        start: Mapping[str, float],
        fit: tuple[str, ...],
        substeps: int,
        dead_band: tuple[float, float] | None,
    ):
        names = [name for name in PARAMETERS if name != "dead_band"]
        for name in fit:
            if name not in names:
                raise CalibrationError(f"cannot fit {name!r}: choose from {', '.join(names)}")
        self.dead_band = dead_band
        self.fixed = with_defaults(dict(start), log)
        self.segment, angle = segments(log)
        self.names = (*dict.fromkeys(fit), *(() if dead_band is None else ("dead_band",)))
        parameters = [PARAMETERS[name] for name in self.names]
        self.low, self.high = (np.array([getattr(p, end) for p in parameters]) for end in ("low", "high"))
        if dead_band is not None:
            self.low[-1], self.high[-1] = dead_band
        self.typical = np.array([p.typical for p in parameters])
        begin = np.array([float(self.fixed[name]) for name in self.names])
        for name, value, low, high in zip(self.names, begin, self.low, self.high, strict=True):
            if not low <= value <= high:
                raise CalibrationError(
                    f"{log.name}: {name} starts at {value:g}, outside its bounds {low:g} to {high:g}"
                )
        self._index = np.array([_NAMES.index(name) for name in self.names])
        self._values = np.array([float(self.fixed[name]) for name in _NAMES])
        self.scale = np.maximum(np.abs(begin), self.typical)
        # From a bound, where a friction's gradient may vanish, the search would not set off.
        inside = 0.05 * np.minimum(self.scale, self.high - self.low)
        self.theta = np.clip(begin, self.low + inside, self.high - inside)
        if dead_band is not None:
            self.theta[-1] = begin[-1]
        self.starts = angle - float(self.fixed["encoder_bias"])
        self.measured = np.stack([log.position] if log.torque is None else [log.position, log.torque])
        self.noise = np.array(_NOISE)[: len(self.measured)]
        self.timestep, self.latency, self.best = log.period / substeps, 0, np.inf
        self._seen: list[tuple[np.ndarray, np.ndarray]] = []  # candidates and their costs
        self._data = _Data(
            jnp.asarray(log.target, jnp.float32),
            jnp.asarray(self.measured, jnp.float32),
            jnp.asarray(self.segment),
            jnp.float32(self.timestep),
            substeps,
        )

    def run(self, latencies: tuple[int, ...]) -> None:
        """Fit once with the given weights, and once with those found."""
        self._scan_latencies(latencies)
        for last in (False, True):
            self._scan_latencies(tuple(lag for lag in latencies if abs(lag - self.latency) <= 1))
            self._settle(last)

    # --- the inner loop ---------------------------------------------------------------------------

    def residual(self, theta: np.ndarray, starts: np.ndarray) -> np.ndarray:
        """Weighted residuals [C * T]."""
        error = self._call(_readings, theta, starts) - self.measured
        return (error / self.noise[:, None]).ravel()

    def jacobian(self, theta: np.ndarray, starts: np.ndarray, count: int | None = None) -> np.ndarray:
        """Of `residual`, [C * T, P + S], by the (first) parameters, in their own units, and the starts."""
        slope = self._call(_slopes, theta, starts) / self.noise[:, None, None]
        own = slope[..., -1:] * (self.segment[:, None] == np.arange(len(starts)))
        slope = np.concatenate([slope[..., self._index[:count]], own], -1)
        return slope.reshape(-1, slope.shape[-1])

    def solve(self, theta: np.ndarray, evaluations: int, fixed: int = 0) -> tuple[float, np.ndarray, np.ndarray]:
        """Sum of squares, theta and starts of the fit by gradient, without the last `fixed` of the parameters."""
        count, parts = len(theta) - fixed, len(self.starts)
        scale = np.concatenate([self.scale[:count], np.full(parts, 0.01)])
        reach = 0.05  # rad that a start may be off the angle that was read
        low = np.concatenate([self.low[:count], self.starts - reach]) / scale
        high = np.concatenate([self.high[:count], self.starts + reach]) / scale

        def split(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            return np.concatenate([x[:count] * scale[:count], theta[count:]]), x[count:] * 0.01

        result = least_squares(
            lambda x: self.residual(*split(x)),
            np.concatenate([theta[:count], self.starts]) / scale,
            jac=lambda x: self.jacobian(*split(x), count) * scale,
            bounds=(low, high),
            xtol=1e-6,
            ftol=1e-7,
            gtol=1e-10,
            max_nfev=evaluations,
        )
        return 2.0 * float(result.cost), *split(result.x)

    def _attempt(self, theta: np.ndarray, evaluations: int) -> float:
        """Sum of squares that is reached from here; keeps the solution if it is the best."""
        cost, theta, starts = self.solve(theta, evaluations)
        if cost < self.best:
            self.best, self.theta, self.starts = cost, theta, starts
        return cost

    def _call(
        self, function: Callable[..., jax.Array], theta: np.ndarray, starts: np.ndarray, *more: Any, far: float = 1e3
    ) -> np.ndarray:
        """`function` of the log, of all parameters [..., len(_NAMES)] from the fitted ones [..., P], and the starts."""
        values = np.broadcast_to(self._values, (*theta.shape[:-1], len(_NAMES))).copy()
        values[..., self._index] = theta
        by_sample = jnp.asarray(starts[self.segment], jnp.float32)
        out = function(self._data, jnp.asarray(values, jnp.float32), by_sample, jnp.int32(self.latency), *more)
        return np.nan_to_num(np.asarray(out, float), nan=far, posinf=far, neginf=-far)

    # --- the outer loops --------------------------------------------------------------------------

    def _scan_latencies(self, candidates: tuple[int, ...]) -> None:
        self.best, costs = np.inf, {}
        for self.latency in candidates:
            costs[self.latency] = self._attempt(self.theta, 6)
        self.latency = min(costs, key=costs.__getitem__)

    def _settle(self, last: bool) -> None:
        """Solve to the end, and take each channel's noise from what the fit leaves."""
        self.best, rugged = np.inf, self.dead_band is not None
        self._attempt(self.theta, 30)
        if rugged and not last:
            self._explore(rounds=6)
        left = self.residual(self.theta, self.starts).reshape(self.measured.shape)
        self.noise = self.noise * np.maximum(np.sqrt(np.mean(left**2, -1)), 1e-6)
        if last:
            self.best = np.sum(self.residual(self.theta, self.starts) ** 2)
            self._explore(rounds=14 if rugged else 3)

    def _explore(self, rounds: int, crowd: int = 256) -> None:
        """Cross-entropy search about the present solution, which a gradient cannot leave: a
        dead-band makes the sum of squares rugged at the scale of the parameters' own errors."""
        count, scale = len(self.theta), self.scale
        slope = self.jacobian(self.theta, self.starts)[:, :count] * scale
        middle = self.theta / scale
        spread = np.linalg.pinv(slope.T @ slope, rcond=1e-8) * 25.0 + 1e-8 * np.eye(count)
        rng, weight = np.random.default_rng(0), 1.0 / jnp.asarray(self.noise, jnp.float32)
        self._seen = []
        for _ in range(rounds):
            tries = rng.multivariate_normal(middle, spread, crowd)
            tries = np.clip(tries, self.low / scale, self.high / scale)
            tries[: 2 * count + 1] = middle
            for end, bound in enumerate((self.low, self.high)):  # Where a limit binds hardly ever, curvature misleads.
                tries[1 + end * count :][range(count), range(count)] = bound / scale
            thetas = tries * scale
            costs = self._call(_crowd_costs, thetas, self.starts, weight, far=np.inf)
            order = np.argsort(costs)
            self._seen.append((thetas, costs))
            elite = tries[order[: crowd // 8]]
            middle, spread = elite[0], 2.0 * np.cov(elite.T) + 1e-12 * np.eye(count)
            before = self.best
            self._attempt(thetas[order[0]], 6)
            if self.best < before:
                middle = self.theta / scale

    # --- what fits as well ------------------------------------------------------------------------

    def plausible(self) -> tuple[np.ndarray, np.ndarray]:
        """Least and largest of each parameter among all candidates that the data do not exclude."""
        limit = self._limit(np.sum(self.residual(self.theta, self.starts) ** 2), self.dead_band is not None)
        thetas, costs = (np.concatenate(parts) for parts in zip(*self._seen, strict=True))
        within = np.concatenate([thetas[costs <= limit], self.theta[None]])
        least, largest = within.min(0), within.max(0)
        if self.dead_band is not None:
            ends = self._profile_dead_band(self.dead_band)
            least[-1], largest[-1] = min(ends[0], least[-1]), max(ends[1], largest[-1])
        return least, largest

    def _profile_dead_band(self, span: tuple[float, float]) -> list[float]:
        """Where the sum of squares, fitted anew, rises by the critical value of a threshold."""
        limit, ends = self._limit(self.solve(self.theta, 15, fixed=1)[0], True), list[float]()
        for way, end in ((-1, span[0]), (1, span[1])):
            step, last = 2e-3 * (span[1] - span[0]), self.theta[-1]
            while way * (end - last) > 0:
                tried = float(np.clip(last + way * step, *span))
                if self.solve(np.append(self.theta[:-1], tried), 6, fixed=1)[0] > limit:
                    break
                last, step = tried, 1.6 * step
            ends.append(float(np.clip(last + way * step, *span)))  # the first that is excluded
        return ends

    def _limit(self, least: float, threshold: bool) -> float:
        """The largest sum of squares that the data do not exclude."""
        freedom = max(self.measured.size - len(self.theta), 1)
        return least * (1 + (_THRESHOLD if threshold else _CHI2) / freedom)
