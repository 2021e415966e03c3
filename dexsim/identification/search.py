"""The search of an identification: one log's least squares.

Inner loop: `scipy.optimize.least_squares` with the gradient through the jitted simulation. Outer loops without
gradient: scans over latency (a whole number) and dead-band (a threshold), and a cross-entropy search, as a dead-band
makes the cost rugged.
"""

import functools
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import least_squares, minimize_scalar

from dexsim.core.errors import CalibrationError
from dexsim.core.pytree import pytree_dataclass, static
from dexsim.identification.joint import PARAMETERS, JointLog, segments, simulate, with_defaults

_BLUR = 2e-3  # rad, width of the dead-band's edges in the gradient
CHI2 = 3.84  # 95 %, one parameter
_THRESHOLD = 7.35  # 95 % for a threshold (Hansen 2000): the likelihood has a kink there
_NOISE = (0.002, 0.02)  # rad, Nm: weights of angle and torque to begin with

# In the order of the arrays below: whatever is fitted, the compiled programs are the same.
_NAMES = tuple(PARAMETERS)


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
    """One log's least squares: theta [P] (what is fitted, the dead-band last), the starts [S], and the latency.

    The arguments are those of `identify`, the log is checked.

    Raises:
      CalibrationError: a name that cannot be fitted, or a first guess out of its bounds.
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
        self.log, self.dead_band = log, dead_band
        self.fixed = with_defaults(dict(start), log)
        self.segment, angle = segments(log)
        self.names = (*dict.fromkeys(fit), "dead_band")
        self.count = len(self.names) - (dead_band is None)
        """Parameters that are fitted in the end."""
        parameters = [PARAMETERS[name] for name in self.names]
        self.low, self.high = (np.array([getattr(p, end) for p in parameters]) for end in ("low", "high"))
        self.low[-1], self.high[-1] = dead_band or (self.low[-1], self.high[-1])
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
        self.theta[-1] = begin[-1]
        self.starts = self._rests = angle - float(self.fixed["encoder_bias"])
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
        for fine in (False, True):
            if self.dead_band is not None:
                self._search_dead_band(self.dead_band, fine)
            self._scan_latencies(tuple(lag for lag in latencies if abs(lag - self.latency) <= 1))
            self._settle(last=fine)

    # --- the inner loop ---------------------------------------------------------------------------

    def residual(self, theta: np.ndarray, starts: np.ndarray) -> np.ndarray:
        """Weighted residuals [C * T]."""
        error = self._call(_readings, theta, starts) - self.measured
        return (error / self.noise[:, None]).ravel()

    def jacobian(self, theta: np.ndarray, starts: np.ndarray) -> np.ndarray:
        """Of `residual`, [C * T, P + S], in the parameters' own units."""
        slope = self._call(_slopes, theta, starts) / self.noise[:, None, None]
        own = slope[..., -1:] * (self.segment[:, None] == np.arange(len(starts)))
        slope = np.concatenate([slope[..., self._index], own], -1)
        return slope.reshape(-1, slope.shape[-1])

    def solve(
        self, theta: np.ndarray, evaluations: int, with_band: bool = False
    ) -> tuple[float, np.ndarray, np.ndarray]:
        """Sum of squares, theta and starts of the fit by gradient; the dead-band stays unless asked."""
        count, parts = len(theta) - (not with_band), len(self.starts)
        scale = np.concatenate([self.scale[:count], np.full(parts, 0.01)])
        reach = 0.05  # rad that a start may be off the angle that was read
        low = np.concatenate([self.low[:count], self.starts - reach]) / scale
        high = np.concatenate([self.high[:count], self.starts + reach]) / scale
        columns = np.r_[np.arange(count), np.arange(len(theta), len(theta) + parts)]

        def split(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            return np.concatenate([x[:count] * scale[:count], theta[count:]]), x[count:] * 0.01

        result = least_squares(
            lambda x: self.residual(*split(x)),
            np.concatenate([theta[:count], self.starts]) / scale,
            jac=lambda x: self.jacobian(*split(x))[:, columns] * scale,
            bounds=(low, high),
            method="trf",
            xtol=1e-6,
            ftol=1e-7,
            gtol=1e-10,
            max_nfev=evaluations,
        )
        return 2.0 * float(result.cost), *split(result.x)

    def _attempt(self, theta: np.ndarray, evaluations: int, with_band: bool = False) -> float:
        """Sum of squares that is reached from here; keeps the solution if it is the best."""
        cost, theta, starts = self.solve(theta, evaluations, with_band)
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

    def _search_dead_band(self, span: tuple[float, float], fine: bool) -> None:
        """Scan the range, or five values about the present one, then Brent's method."""
        cell = (span[1] - span[0]) / 10
        near = np.clip(self.theta[-1] + np.array([-0.6, -0.3, 0.0, 0.3, 0.6]) * cell, *span)
        grid = near if fine else np.linspace(*span, 11)
        self.best = np.inf

        def cost(width: float) -> float:
            return self._attempt(np.append(self.theta[:-1], width), 5)

        at = int(np.argmin([cost(width) for width in grid]))
        minimize_scalar(
            cost,
            method="bounded",
            bounds=(grid[max(at - 1, 0)], grid[min(at + 1, len(grid) - 1)]),
            options={"xatol": 2e-3 * (span[1] - span[0])},
        )

    def _settle(self, last: bool) -> None:
        """Solve to the end, and take each channel's noise from what the fit leaves."""
        self.best, with_band = np.inf, self.dead_band is not None
        self._attempt(self.theta, 30)
        if with_band:
            self._attempt(self.theta, 30, with_band=True)
        # Without a dead-band there is next to nothing to get lost in.
        self._start_over(tries=(6 if last else 10) if with_band else 2)
        if with_band and not last:
            self._explore(rounds=6)
        left = self.residual(self.theta, self.starts).reshape(self.measured.shape)
        self.noise = self.noise * np.maximum(np.sqrt(np.mean(left**2, -1)), 1e-6)
        if last:
            self.best = np.sum(self.residual(self.theta, self.starts) ** 2)
            self._explore(rounds=14 if with_band else 3)

    def _start_over(self, tries: int) -> None:
        """Solve again from about the present parameters and from the angles as they were read: a valley to which both
        have settled together has no other way out."""
        rng, best, starts = np.random.default_rng(1), self.theta, self.starts
        for index in range(tries):
            width = 0.02 * 3.0 ** (index % 3)  # 2, 6 and 18 %
            theta = best + width * self.scale * rng.standard_normal(len(best))
            theta[self.count :] = best[self.count :]
            self.starts = self._rests
            result = self.solve(np.clip(theta, self.low, self.high), 12, self.dead_band is not None)
            if result[0] < self.best:
                self.best, best, starts = result
        self.theta, self.starts = best, starts

    def _explore(self, rounds: int, crowd: int = 256) -> None:
        """Cross-entropy search about the present solution, which a gradient cannot leave: a
        dead-band makes the sum of squares rugged at the scale of the parameters' own errors."""
        count, scale = self.count, self.scale[: self.count]
        slope = self.jacobian(self.theta, self.starts)[:, :count] * scale
        middle = self.theta[:count] / scale
        spread = np.linalg.pinv(slope.T @ slope, rcond=1e-8) * 25.0 + 1e-8 * np.eye(count)
        rng, weight = np.random.default_rng(0), 1.0 / jnp.asarray(self.noise, jnp.float32)
        self._seen = []
        for _ in range(rounds):
            tries = rng.multivariate_normal(middle, spread, crowd)
            tries = np.clip(tries, self.low[:count] / scale, self.high[:count] / scale)
            tries[: 2 * count + 1] = middle
            for end, bound in enumerate((self.low, self.high)):  # Where a limit binds hardly ever, curvature misleads.
                tries[1 + end * count :][range(count), range(count)] = bound[:count] / scale
            thetas = np.tile(self.theta, (crowd, 1))
            thetas[:, :count] = tries * scale
            costs = self._call(_crowd_costs, thetas, self.starts, weight, far=np.inf)
            order = np.argsort(costs)
            self._seen.append((thetas, costs))
            elite = tries[order[: crowd // 8]]
            middle, spread = elite[0], 2.0 * np.cov(elite.T) + 1e-12 * np.eye(count)
            before = self.best
            self._attempt(thetas[order[0]], 6, self.dead_band is not None)
            if self.best < before:
                middle = self.theta[:count] / scale

    # --- what fits as well ------------------------------------------------------------------------

    def plausible(self) -> tuple[np.ndarray, np.ndarray]:
        """Least and largest of each parameter among all candidates that the data do not exclude."""
        limit = self._limit(np.sum(self.residual(self.theta, self.starts) ** 2), self.dead_band is not None)
        thetas, costs = (np.concatenate(parts) for parts in zip(*self._seen, strict=True))
        within = np.concatenate([thetas[costs <= limit], self.theta[None]])
        return within.min(0), within.max(0)

    def dead_band_profile(self, span: tuple[float, float]) -> tuple[float, float]:
        """Where the sum of squares, fitted anew, rises by the critical value of a threshold."""
        limit, ends = self._limit(self.solve(self.theta, 15)[0], True), []
        for way, end in ((-1, span[0]), (1, span[1])):
            step, last = 2e-3 * (span[1] - span[0]), self.theta[-1]
            while way * (end - last) > 0:
                tried = float(np.clip(last + way * step, *span))
                if self.solve(np.append(self.theta[:-1], tried), 6)[0] > limit:
                    break
                last, step = tried, 1.6 * step
            ends.append(float(np.clip(last + way * step, *span)))  # the first that is excluded
        return ends[0], ends[1]

    def _limit(self, least: float, threshold: bool) -> float:
        """The largest sum of squares that the data do not exclude."""
        freedom = max(self.measured.size - len(self.theta), 1)
        return least * (1 + (_THRESHOLD if threshold else CHI2) / freedom)
