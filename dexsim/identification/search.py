"""The search of an identification: one log's least squares, from several starts.

A start is solved by `scipy.optimize.least_squares` with the gradient through the jitted simulation. Latency (a whole
number) and dead-band (a threshold) are scanned. A dead-band makes the sum of squares rugged: restarts about the best
solution leave its small valleys, and show what fits as well.
"""

import functools
from collections.abc import Callable, Mapping

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import least_squares

from dexsim.core.errors import CalibrationError
from dexsim.core.pytree import pytree_dataclass, static
from dexsim.identification.joint import PARAMETERS, JointLog, segments, simulate, with_defaults

_BLUR = 2e-3  # rad, width of the dead-band's edges in the gradient
CHI2 = 3.84  # 95 %, one parameter
_THRESHOLD = 7.35  # 95 % for a threshold (Hansen 2000): the likelihood has a kink there
_NOISE = (0.002, 0.02)  # rad, Nm: weights of angle and torque to begin with
_REACH = 0.05  # rad that a start may be off the angle that was read
_WIDTHS = (0.18, 0.06, 0.02, 0.006)  # of restarts, as shares of the parameters
_RESTARTS = 8, 40  # without and with a dead-band

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
        if unknown := sorted(set(fit) - set(names)):
            raise CalibrationError(f"cannot fit {unknown[0]!r}: choose from {', '.join(names)}")
        self.log, self.dead_band = log, dead_band
        self.fixed = with_defaults(dict(start), log)
        self.segment, angle = segments(log)
        self.names = (*dict.fromkeys(fit), *(["dead_band"] if dead_band else []))
        parameters = [PARAMETERS[name] for name in self.names]
        self.low, self.high = (np.array([getattr(p, end) for p in parameters]) for end in ("low", "high"))
        if dead_band:
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
        self.starts = self._rests = angle - float(self.fixed["encoder_bias"])
        self.measured = np.stack([log.position] if log.torque is None else [log.position, log.torque])
        self.noise = np.array(_NOISE)[: len(self.measured)]
        self.timestep, self.latency, self.best = log.period / substeps, 0, np.inf
        self._seen: list[tuple[float, np.ndarray]] = []  # sums of squares and theta of all solutions
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
        for span in (np.linspace(0.0, 1.0, 11), np.zeros(0)):
            self.best = np.inf
            self._attempt(self.theta, 30)
            for share in span if self.dead_band else ():
                self._attempt(np.append(self.theta[:-1], self.low[-1] + share * (self.high[-1] - self.low[-1])), 12)
            self._scan_latencies(tuple(lag for lag in latencies if abs(lag - self.latency) <= 1))
            self._restart()
            left = self.residual(self.theta, self.starts).reshape(self.measured.shape)
            self.noise = self.noise * np.maximum(np.sqrt(np.mean(left**2, -1)), 1e-6)
        self._restart()

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
        self, theta: np.ndarray, evaluations: int, starts: np.ndarray | None = None, hold_last: bool = False
    ) -> tuple[float, np.ndarray, np.ndarray]:
        """Sum of squares, theta and starts of the fit by gradient; the last parameter may be held."""
        starts = self.starts if starts is None else starts
        count, free = len(theta), np.ones(len(theta) + len(starts), bool)
        free[count - 1] = not hold_last
        scale = np.concatenate([self.scale, np.full(len(starts), 0.01)])
        whole = np.concatenate([theta, starts]) / scale
        low = np.concatenate([self.low, self._rests - _REACH]) / scale
        high = np.concatenate([self.high, self._rests + _REACH]) / scale

        def split(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            whole[free] = x
            return whole[:count] * scale[:count], whole[count:] * scale[count:]

        result = least_squares(
            lambda x: self.residual(*split(x)),
            np.clip(whole, low, high)[free],
            jac=lambda x: (self.jacobian(*split(x)) * scale)[:, free],
            bounds=(low[free], high[free]),
            xtol=1e-6,
            ftol=1e-7,
            gtol=1e-10,
            max_nfev=evaluations,
        )
        return 2.0 * float(result.cost), *split(result.x)

    def _call(self, function: Callable[..., jax.Array], theta: np.ndarray, starts: np.ndarray) -> np.ndarray:
        """`function` of the log, of all parameters from the fitted ones, and of the starts."""
        values = self._values.copy()
        values[self._index] = theta
        by_sample = jnp.asarray(starts[self.segment], jnp.float32)
        out = function(self._data, jnp.asarray(values, jnp.float32), by_sample, jnp.int32(self.latency))
        return np.nan_to_num(np.asarray(out, float), nan=1e3, posinf=1e3, neginf=-1e3)

    def _attempt(self, theta: np.ndarray, evaluations: int, starts: np.ndarray | None = None) -> float:
        """Sum of squares that is reached from here; keeps the solution if it is the best."""
        cost, theta, starts = self.solve(theta, evaluations, starts)
        self._seen.append((cost, theta))
        if cost < self.best:
            self.best, self.theta, self.starts = cost, theta, starts
        return cost

    def _scan_latencies(self, candidates: tuple[int, ...]) -> None:
        self.best, costs = np.inf, {}
        for self.latency in candidates:
            costs[self.latency] = self._attempt(self.theta, 6)
        self.latency = min(costs, key=costs.__getitem__)

    def _restart(self) -> None:
        """Solve again from about the best parameters, every other time with the angles as they were read: a valley to
        which both have settled together has no other way out."""
        rng = np.random.default_rng(1)
        self.best, self._seen = np.inf, []
        self._attempt(self.theta, 30)
        for index in range(_RESTARTS[self.dead_band is not None]):
            width = _WIDTHS[index // 2 % len(_WIDTHS)]
            theta = self.theta + width * self.scale * rng.standard_normal(len(self.theta))
            self._attempt(np.clip(theta, self.low, self.high), 12, self._rests if index % 2 else self.starts)

    # --- what fits as well ------------------------------------------------------------------------

    def plausible(self) -> tuple[np.ndarray, np.ndarray]:
        """Least and largest of each parameter among all solutions that the data do not exclude."""
        limit = self._limit(self.best)
        within = np.stack([theta for cost, theta in self._seen if cost <= limit])
        return within.min(0), within.max(0)

    def dead_band_profile(self) -> tuple[float, float]:
        """Where the sum of squares, fitted anew, rises by the critical value of a threshold."""
        limit, low, high, ends = self._limit(self.best), self.low[-1], self.high[-1], []
        for way, end in ((-1, low), (1, high)):
            step, last = 2e-3 * (high - low), self.theta[-1]
            while way * (end - last) > 0:
                tried = float(np.clip(last + way * step, low, high))
                if self.solve(np.append(self.theta[:-1], tried), 6, hold_last=True)[0] > limit:
                    break
                last, step = tried, 1.6 * step
            ends.append(float(np.clip(last + way * step, low, high)))  # the first that is excluded
        return ends[0], ends[1]

    def _limit(self, least: float) -> float:
        """The largest sum of squares that the data do not exclude."""
        freedom = max(self.measured.size - len(self.theta), 1)
        return least * (1 + (CHI2 if self.dead_band is None else _THRESHOLD) / freedom)
