"""The search of an identification: one log's least squares.

Inner loop: `scipy.optimize.least_squares` with the gradient through the jitted simulation. Around it a scan over
latencies (a whole number), and for a dead-band, which makes the cost rugged, `scipy.optimize.differential_evolution`.
"""

import functools
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import differential_evolution, least_squares

from dexsim.core.errors import CalibrationError
from dexsim.core.pytree import pytree_dataclass, static
from dexsim.identification.joint import PARAMETERS, JointLog, segments, simulate, with_defaults

_BLUR = 2e-3  # rad, width of the dead-band's edges in the gradient
_CHI2 = 3.84  # 95 %, one parameter
_THRESHOLD = 7.35  # 95 % for a threshold (Hansen 2000): the likelihood has a kink there
_NOISE = (0.002, 0.02)  # rad, Nm: weights of angle and torque to begin with
_CROWD, _GENERATIONS, _CLOUD = 64, 60, 512  # candidates of a generation; generations; candidates of a cloud
_REACH = (40.0, 8.0)  # standard deviations that evolution reaches, at first and with the weights found

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
        self._data = _Data(
            jnp.asarray(log.target, jnp.float32),
            jnp.asarray(self.measured, jnp.float32),
            jnp.asarray(self.segment),
            jnp.float32(self.timestep),
            substeps,
        )

    def run(self, latencies: tuple[int, ...]) -> None:
        """Fit once with the given weights, and once with those found: the noise that a fit leaves in each channel."""
        self._scan_latencies(latencies)
        if self.dead_band is not None:
            self.best, theta = np.inf, self.theta
            for width in np.linspace(*self.dead_band, 11):
                self._attempt(np.append(theta[:-1], width), 5)
        for reach in _REACH:
            self._scan_latencies(tuple(lag for lag in latencies if abs(lag - self.latency) <= 1))
            self.best = np.inf
            self._attempt(self.theta, 30)
            if self.dead_band is not None:
                self._attempt(self.theta, 30, with_band=True)
                self._evolve(reach)
            left = self.residual(self.theta, self.starts).reshape(self.measured.shape)
            self.noise = self.noise * np.maximum(np.sqrt(np.mean(left**2, -1)), 1e-6)

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

    def _evolve(self, reach: float) -> None:
        """Leave a valley by differential evolution, up to `reach` standard deviations around the present solution.

        The joints start from the angles that were read: those of the solution have settled in the valley with it.
        """
        spread, starts, before = self._spread(), self.starts, self.best
        self.starts = self._rests

        def costs(steps: np.ndarray) -> np.ndarray:
            return self._costs(self.theta + steps.T @ spread)

        result = differential_evolution(
            costs,
            [(-reach, reach)] * self.count,
            x0=np.zeros(self.count),
            vectorized=True,
            updating="deferred",
            popsize=_CROWD // self.count,
            maxiter=_GENERATIONS,
            polish=False,
            seed=0,
        )
        start = np.append(self._clip(self.theta + result.x @ spread), self.theta[self.count :])
        if self._attempt(start, 20, with_band=True) >= before:
            self.starts = starts

    def _spread(self) -> np.ndarray:
        """[P, P] steps in theta of one standard deviation each, along the axes of the valley."""
        slope = self.jacobian(self.theta, self.starts)[:, : self.count] * self.scale[: self.count]
        _, singular, axes = np.linalg.svd(slope, full_matrices=False)
        return axes / np.maximum(singular, 1e-4 * singular[0])[:, None] * self.scale[: self.count]

    def _clip(self, theta: np.ndarray) -> np.ndarray:
        return np.clip(theta, self.low[: self.count], self.high[: self.count])

    def _costs(self, thetas: np.ndarray) -> np.ndarray:
        """Weighted sums of squares [N] for the fitted parameters [N, count], others and starts as they are."""
        whole = np.tile(self.theta, (len(thetas), 1))
        whole[:, : self.count] = self._clip(thetas)
        weight = 1.0 / jnp.asarray(self.noise, jnp.float32)
        return self._call(_crowd_costs, whole, self.starts, weight, far=np.inf)

    # --- what fits as well ------------------------------------------------------------------------

    def plausible(self) -> tuple[np.ndarray, np.ndarray]:
        """Least and largest [count] of each fitted parameter in a cloud of candidates that the data do not exclude."""
        theta = self.theta[: self.count]
        steps = np.random.default_rng(0).standard_normal((_CLOUD, self.count))
        steps *= np.linspace(0.1, 4.0, _CLOUD)[:, None] / np.linalg.norm(steps, axis=1, keepdims=True)
        thetas = self._clip(theta + steps @ self._spread())
        limit = self._limit(np.sum(self.residual(self.theta, self.starts) ** 2), self.dead_band is not None)
        within = np.concatenate([thetas[self._costs(thetas) <= limit], theta[None]])
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
        return least * (1 + (_THRESHOLD if threshold else _CHI2) / freedom)
