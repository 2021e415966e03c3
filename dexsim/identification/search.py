"""The search of an identification: one log's least squares.

Inner loop: `scipy.optimize.least_squares` with the gradient through the jitted simulation. Outer loops without
gradient: a scan over latency (a whole number), restarts from other dead-bands and parameters, and a cross-entropy
search, as a dead-band makes the cost rugged.
"""

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import least_squares

from dexsim.core.errors import CalibrationError
from dexsim.identification.joint import PARAMETERS, JointLog, segments, simulate, with_defaults

_BLUR = 2e-3  # rad, width of the dead-band's edges in the gradient
CHI2 = 3.84  # 95 %, one parameter
_THRESHOLD = 7.35  # 95 % for a threshold (Hansen 2000): the likelihood has a kink there
_NOISE = (0.002, 0.02)  # rad, Nm: weights of angle and torque to begin with
_WIDTHS = 7  # dead-bands that the search begins from
_REACH, _START = 0.05, 0.01  # rad that a start may be off the angle that was read; its scale
_CROWD = 256  # candidates of a round of the cross-entropy search

# In the order of the arrays below: whatever is fitted, the compiled programs are the same.
_NAMES = tuple(PARAMETERS)


class _Data(NamedTuple):
    """A log on the device."""

    target: jax.Array  # [T] rad
    measured: jax.Array  # [2, T] rad and Nm; where no torque was recorded, anything
    segment: jax.Array  # [T]
    timestep: jax.Array  # s


@functools.partial(jax.jit, static_argnames=("substeps", "blur"))
def _readings(
    data: _Data, substeps: int, values: jax.Array, starts: jax.Array, latency: jax.Array, blur: float = 0.0
) -> jax.Array:
    """[2, T] angle and torque, from all parameters and each sample's segment's start [T]."""
    named = dict(zip(_NAMES, values, strict=True)) | {"start": starts}
    return jnp.stack(simulate(named, data.target, latency, data.timestep, substeps, data.segment, blur))


@functools.partial(jax.jit, static_argnames="substeps")
def _slopes(data: _Data, substeps: int, values: jax.Array, starts: jax.Array, latency: jax.Array) -> jax.Array:
    """[2, T, P + 1] derivatives of `_readings` by all parameters and by the segment's start.

    The dead-band's edges are blurred: the exact gradient does not see that a parameter moves the
    instant at which the torque switches.
    """

    def blurred(values: jax.Array, shift: jax.Array) -> jax.Array:
        return _readings(data, substeps, values, starts + shift, latency, blur=_BLUR)

    by_value, by_start = jax.jacfwd(blurred, (0, 1))(values, jnp.zeros(()))
    return jnp.concatenate([by_value, by_start[..., None]], -1)


@functools.partial(jax.jit, static_argnames="substeps")
def _crowd_costs(
    data: _Data, substeps: int, crowd: jax.Array, starts: jax.Array, latency: jax.Array, weight: jax.Array
) -> jax.Array:
    """Weighted sums of squares [N] for parameters [N, P]."""

    def cost(values: jax.Array) -> jax.Array:
        error = _readings(data, substeps, values, starts, latency) - data.measured
        return jnp.sum((error * weight[:, None]) ** 2)

    return jax.vmap(cost)(crowd)


class Fit(NamedTuple):
    """What was reached: the weighted sum of squares, the fitted parameters [P], and the true angle [S] rad at the begin
    of each segment."""

    cost: float
    theta: np.ndarray
    starts: np.ndarray


class Search:
    """One log's least squares. The arguments are those of `identify`, the log is checked.

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
        bounds = {name: (PARAMETERS[name].low, PARAMETERS[name].high) for name in fit}
        if dead_band is not None:
            bounds["dead_band"] = dead_band
        self.names, self.dead_band, self.fixed = tuple(bounds), dead_band, with_defaults(dict(start), log)
        self.low, self.high = np.array(list(bounds.values())).T
        begin = np.array([float(self.fixed[name]) for name in bounds])
        for value, (name, (low, high)) in zip(begin, bounds.items(), strict=True):
            if not low <= value <= high:
                raise CalibrationError(
                    f"{log.name}: {name} starts at {value:g}, outside its bounds {low:g} to {high:g}"
                )
        self.segment, angle = segments(log)
        self._index = np.array([_NAMES.index(name) for name in bounds])
        self._values = np.array([float(self.fixed[name]) for name in _NAMES])
        self.typical = np.array([PARAMETERS[name].typical for name in bounds])
        self._scale = np.maximum(np.abs(begin), self.typical)
        # From a bound, where a friction's gradient may vanish, the search would not set off.
        inside = 0.05 * np.minimum(self._scale, self.high - self.low)
        self._rests = angle - float(self.fixed["encoder_bias"])
        self.best = Fit(np.inf, np.clip(begin, self.low + inside, self.high - inside), self._rests)
        self.measured = np.stack([log.position] if log.torque is None else [log.position, log.torque])
        self.noise = np.array(_NOISE)[: len(self.measured)]
        self.timestep, self.latency, self._substeps = log.period / substeps, 0, substeps
        self._seen: list[tuple[np.ndarray, np.ndarray]] = []  # candidates and their costs
        self._data = _Data(
            jnp.asarray(log.target, jnp.float32),
            jnp.asarray(self.measured[[0, -1]], jnp.float32),
            jnp.asarray(self.segment),
            jnp.float32(self.timestep),
        )

    def run(self, latencies: tuple[int, ...]) -> None:
        """Fit once with the given weights, and once with those found."""
        if self.dead_band is not None:
            self._scan_latencies(latencies)
            for width in np.linspace(*self.dead_band, _WIDTHS):
                self._attempt(np.append(self.best.theta[:-1], width), 15)
        for last in (False, True):
            self._scan_latencies(latencies)
            self._settle(last)

    # --- the inner loop ---------------------------------------------------------------------------

    def residual(self, theta: np.ndarray, starts: np.ndarray) -> np.ndarray:
        """Weighted residuals [C * T] of the C channels: the angle, and the torque if it was recorded."""
        error = self._call(_readings, theta, starts)[: len(self.noise)] - self.measured
        return (error / self.noise[:, None]).ravel()

    def jacobian(self, theta: np.ndarray, starts: np.ndarray) -> np.ndarray:
        """Of `residual`, [C * T, P + S], in the parameters' own units."""
        slope = self._call(_slopes, theta, starts)[: len(self.noise)] / self.noise[:, None, None]
        own = slope[..., -1:] * (self.segment[:, None] == np.arange(len(starts)))
        slope = np.concatenate([slope[..., self._index], own], -1)
        return slope.reshape(-1, slope.shape[-1])

    def solve(self, theta: np.ndarray, starts: np.ndarray, evaluations: int) -> Fit:
        """The fit by gradient from here."""
        scale, count = np.append(self._scale, np.full(len(starts), _START)), len(theta)
        bounds = np.append(self.low, starts - _REACH) / scale, np.append(self.high, starts + _REACH) / scale

        def split(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            return x[:count] * scale[:count], x[count:] * _START

        result = least_squares(
            lambda x: self.residual(*split(x)),
            np.append(theta, starts) / scale,
            jac=lambda x: self.jacobian(*split(x)) * scale,
            bounds=bounds,
            xtol=1e-6,
            ftol=1e-7,
            gtol=1e-10,
            max_nfev=evaluations,
        )
        return Fit(2.0 * float(result.cost), *split(result.x))

    def _attempt(self, theta: np.ndarray, evaluations: int, starts: np.ndarray | None = None) -> None:
        """Solve from here; keep what is reached if it is the best."""
        reached = self.solve(theta, self.best.starts if starts is None else starts, evaluations)
        self.best = min(self.best, reached, key=lambda fit: fit.cost)

    def _call(
        self, function: Callable[..., jax.Array], theta: np.ndarray, starts: np.ndarray, *more: Any, far: float = 1e3
    ) -> np.ndarray:
        """`function` of the log, of all parameters [..., len(_NAMES)] from the fitted ones [..., P], and the starts."""
        values = np.broadcast_to(self._values, (*theta.shape[:-1], len(_NAMES))).copy()
        values[..., self._index] = theta
        arrays = jnp.asarray(values, jnp.float32), jnp.asarray(starts[self.segment], jnp.float32)
        out = function(self._data, self._substeps, *arrays, jnp.int32(self.latency), *more)
        return np.nan_to_num(np.asarray(out, float), nan=far, posinf=far, neginf=-far)

    # --- the outer loops --------------------------------------------------------------------------

    def costs_by_latency(self, latencies: Sequence[int], evaluations: int) -> dict[int, float]:
        """The sum of squares of each latency, all solved from the present solution."""
        now, costs = self.latency, {}
        for self.latency in latencies:
            costs[self.latency] = self.solve(*self.best[1:], evaluations).cost
        self.latency = now
        return costs

    def _scan_latencies(self, latencies: tuple[int, ...]) -> None:
        costs = self.costs_by_latency(latencies, 6) if len(latencies) > 1 else dict.fromkeys(latencies, 0.0)
        self.latency = min(costs, key=costs.__getitem__)
        self.best = self.best._replace(cost=np.inf)  # that of another latency

    def _settle(self, last: bool) -> None:
        """Solve to the end, and take each channel's noise from what the fit leaves."""
        rugged = self.dead_band is not None  # else there is next to nothing to get lost in
        self._attempt(self.best.theta, 30)
        self._start_over(tries=8 if rugged else 2 * last)
        if rugged and not last:
            self._explore(rounds=6)
        left = self.residual(*self.best[1:]).reshape(self.measured.shape)
        self.noise = self.noise * np.maximum(np.sqrt(np.mean(left**2, -1)), 1e-6)
        self.best = self.best._replace(cost=np.sum(self.residual(*self.best[1:]) ** 2))
        if last:
            self._explore(rounds=14 if rugged else 3)

    def _start_over(self, tries: int) -> None:
        """Solve again from about the present parameters and from the angles as they were read: a valley to which both
        have settled together has no other way out."""
        rng = np.random.default_rng(1)
        for index in range(tries):
            width = 0.02 * 3.0 ** (index % 3)  # 2, 6 and 18 %
            theta = self.best.theta + width * self._scale * rng.standard_normal(len(self._scale))
            self._attempt(np.clip(theta, self.low, self.high), 12, self._rests)

    def _explore(self, rounds: int) -> None:
        """Cross-entropy search about the present solution, which a gradient cannot leave: a
        dead-band makes the sum of squares rugged at the scale of the parameters' own errors."""
        scale, count = self._scale, len(self._scale)
        slope = self.jacobian(*self.best[1:])[:, :count] * scale
        middle = self.best.theta / scale
        spread = np.linalg.pinv(slope.T @ slope, rcond=1e-8) * 25.0 + 1e-8 * np.eye(count)
        rng, weight = np.random.default_rng(0), np.append(1.0 / self.noise, 0.0)[:2].astype(np.float32)
        self._seen = []
        for _ in range(rounds):
            tries = rng.multivariate_normal(middle, spread, _CROWD)
            tries[: 2 * count + 1] = middle
            for end, bound in enumerate((self.low, self.high)):  # Where a limit binds hardly ever, curvature misleads.
                tries[1 + end * count :][range(count), range(count)] = bound / scale
            tries = np.clip(tries, self.low / scale, self.high / scale)
            costs = self._call(_crowd_costs, tries * scale, self.best.starts, weight, far=np.inf)
            self._seen.append((tries * scale, costs))
            elite, before = tries[np.argsort(costs)[: _CROWD // 8]], self.best
            self._attempt(elite[0] * scale, 6)
            middle = elite[0] if self.best is before else self.best.theta / scale
            spread = 2.0 * np.cov(elite.T).reshape(count, count) + 1e-12 * np.eye(count)

    def plausible(self) -> tuple[np.ndarray, np.ndarray]:
        """Least and largest of each parameter among all candidates that the data do not exclude."""
        least = np.sum(self.residual(*self.best[1:]) ** 2)
        critical = CHI2 if self.dead_band is None else _THRESHOLD
        limit = least * (1 + critical / max(self.measured.size - len(self.names), 1))
        thetas, costs = (np.concatenate(parts) for parts in zip(*self._seen, strict=True))
        within = np.concatenate([thetas[costs <= limit], self.best.theta[None]])
        return within.min(0), within.max(0)
