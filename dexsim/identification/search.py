"""The search of an identification: one log's least squares, inner and outer loops.

Inner loop: `scipy.optimize.least_squares` with the gradient through the jitted simulation. Outer loops without
gradient: scans over latency and dead-band, and a cross-entropy search, as a dead-band makes the cost rugged.
"""

import functools
from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np

from dexsim.core.errors import CalibrationError
from dexsim.identification.joint import PARAMETERS, JointLog, segments, simulate, with_defaults
from dexsim.identification.report import TYPICAL

BOUNDS = {
    "stiffness": (0.01, 100.0),
    "damping": (0.0, 10.0),
    "stall_torque": (0.01, 10.0),
    "no_load_speed": (0.5, 100.0),
    "efficiency": (0.2, 1.5),
    "encoder_bias": (-0.2, 0.2),
    "coulomb_friction": (0.0, 1.0),
    "viscous_friction": (0.0, 1.0),
    "inertia": (1e-5, 0.1),
    "gravity_cos": (-1.0, 1.0),
    "gravity_sin": (-1.0, 1.0),
}
"""Default bounds of the search."""

BLUR = 2e-3
"""rad, width of the dead-band's edges in the gradient."""

CHI2 = 3.84  # 95 %, one parameter
_THRESHOLD = 7.35  # 95 % for a threshold (Hansen 2000): the likelihood has a kink there


# All parameters of the model but the starts, in the order of the arrays below: whatever is fitted,
# the compiled programs are the same.
_NAMES = tuple(name for name in PARAMETERS if name != "start")


@functools.partial(jax.jit, static_argnames=("substeps", "blur"))
def _readings(
    values: jax.Array,
    starts: jax.Array,
    target: jax.Array,
    segment: jax.Array,
    latency: jax.Array,
    timestep: jax.Array,
    substeps: int,
    blur: float = 0.0,
) -> jax.Array:
    """[2, T] angle and torque, from all parameters and each sample's segment's start [T]."""
    named = dict(zip(_NAMES, values, strict=True)) | {"start": starts}
    return jnp.stack(simulate(named, target, latency, timestep, substeps, segment, blur))


@functools.partial(jax.jit, static_argnames="substeps")
def _slopes(
    values: jax.Array,
    starts: jax.Array,
    target: jax.Array,
    segment: jax.Array,
    latency: jax.Array,
    timestep: jax.Array,
    substeps: int,
) -> jax.Array:
    """[2, T, P + 1] derivatives of `_readings` by all parameters and by the segment's start.

    The dead-band's edges are blurred: the exact gradient does not see that a parameter moves the
    instant at which the torque switches.
    """

    def blurred(values: jax.Array, shift: jax.Array) -> jax.Array:
        return _readings(values, starts + shift, target, segment, latency, timestep, substeps, blur=BLUR)

    by_value, by_start = jax.jacfwd(blurred, (0, 1))(values, jnp.zeros(()))
    return jnp.concatenate([by_value, by_start[..., None]], -1)


@functools.partial(jax.jit, static_argnames="substeps")
def _crowd_costs(
    crowd: jax.Array,
    starts: jax.Array,
    target: jax.Array,
    segment: jax.Array,
    latency: jax.Array,
    timestep: jax.Array,
    substeps: int,
    measured: jax.Array,
    weight: jax.Array,
) -> jax.Array:
    """Weighted sums of squares [N] for parameters [N, P]."""

    def cost(values: jax.Array) -> jax.Array:
        out = _readings(values, starts, target, segment, latency, timestep, substeps)
        return jnp.sum(((out[: len(weight)] - measured) * weight[:, None]) ** 2)

    return jax.vmap(cost)(crowd)


class Problem:
    """One log's least squares: theta (what is fitted, the dead-band last) and the starts [S]."""

    def __init__(
        self,
        log: JointLog,
        start: Mapping[str, float],
        fit: tuple[str, ...],
        substeps: int,
        bounds: Mapping[str, tuple[float, float]],
        noise: np.ndarray,
    ):
        odd = [name for name in fit if name not in bounds or name == "dead_band"]
        if odd:
            raise CalibrationError(
                f"{odd[0]} cannot be named in fit: choose from "
                f"{', '.join(BOUNDS)}; the dead-band and the latency are "
                "searched by their own arguments"
            )
        self.log, self.substeps, self.noise = log, substeps, noise
        self.fixed = with_defaults(dict(start), log)
        self.segment, angle = segments(log)
        self.names = (*dict.fromkeys(fit), "dead_band")
        self._index = np.array([_NAMES.index(name) for name in self.names])
        self._values = np.array([float(self.fixed[name]) for name in _NAMES])
        begin = np.array([float(self.fixed[name]) for name in self.names])
        self.scale = np.maximum(np.abs(begin), [TYPICAL[name] for name in self.names])
        self.low, self.high = np.array([bounds[name] for name in self.names], float).T
        outside = (begin < self.low) | (begin > self.high)
        if np.any(outside):
            name = self.names[int(np.argmax(outside))]
            raise CalibrationError(
                f"{log.name}: {name} starts at {float(self.fixed[name]):g}, outside its bounds {bounds[name]}"
            )
        # From a bound, where a friction's gradient may vanish, the search would not set off.
        inside = 0.05 * np.minimum(self.scale, self.high - self.low)
        self.theta = np.clip(begin, self.low + inside, self.high - inside)
        self.theta[-1] = begin[-1]
        self.starts = self.rests = angle - float(self.fixed["encoder_bias"])
        channels = [log.position] if log.torque is None else [log.position, log.torque]
        self.measured = np.stack(channels)
        self.target = jnp.asarray(log.target, jnp.float32)
        self.timestep = log.period / substeps
        self.best = np.inf

    def _all(self, theta: np.ndarray) -> jax.Array:
        """All parameters [..., len(_NAMES)] from the fitted ones [..., P]."""
        values = np.broadcast_to(self._values, (*theta.shape[:-1], len(_NAMES))).copy()
        values[..., self._index] = theta
        return jnp.asarray(values, jnp.float32)

    def _call(self, function, theta: np.ndarray, starts: np.ndarray, latency: int) -> np.ndarray:
        out = function(
            self._all(theta),
            jnp.asarray(starts[self.segment], jnp.float32),
            self.target,
            self.segment,
            jnp.int32(latency),
            jnp.float32(self.timestep),
            self.substeps,
        )
        out = np.nan_to_num(np.asarray(out, float), nan=1e3, posinf=1e3, neginf=-1e3)
        return out[: len(self.measured)]

    def residual(self, theta: np.ndarray, starts: np.ndarray, latency: int) -> np.ndarray:
        """Weighted residuals [channels * T]."""
        error = self._call(_readings, theta, starts, latency) - self.measured
        return (error / self.noise[: len(error), None]).ravel()

    def jacobian(self, theta: np.ndarray, starts: np.ndarray, latency: int) -> np.ndarray:
        """Of `residual`, [channels * T, P + S], in the parameters' own units."""
        slope = self._call(_slopes, theta, starts, latency)
        slope = slope / self.noise[: len(slope), None, None]
        own = slope[..., -1:] * (self.segment[:, None] == np.arange(len(starts)))
        slope = np.concatenate([slope[..., self._index], own], -1)
        return slope.reshape(-1, slope.shape[-1])

    def solve(
        self, theta: np.ndarray, latency: int, evaluations: int, with_band: bool = False
    ) -> tuple[float, np.ndarray, np.ndarray]:
        """Sum of squares, theta and starts of the fit by gradient; the dead-band stays if asked."""
        from scipy.optimize import least_squares

        count, parts = len(theta) - (not with_band), len(self.starts)
        scale = np.concatenate([self.scale[:count], np.full(parts, 0.01)])
        reach = np.full(parts, 0.05)
        low = np.concatenate([self.low[:count], self.starts - reach]) / scale
        high = np.concatenate([self.high[:count], self.starts + reach]) / scale
        columns = np.r_[np.arange(count), np.arange(len(theta), len(theta) + parts)]

        def split(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            return np.concatenate([x[:count] * scale[:count], theta[count:]]), x[count:] * 0.01

        result = least_squares(
            lambda x: self.residual(*split(x), latency),
            np.concatenate([theta[:count], self.starts]) / scale,
            jac=lambda x: self.jacobian(*split(x), latency)[:, columns] * scale,
            bounds=(low, high),
            method="trf",
            xtol=1e-6,
            ftol=1e-7,
            gtol=1e-10,
            max_nfev=evaluations,
        )
        return 2.0 * float(result.cost), *split(result.x)

    def attempt(self, latency: int, evaluations: int, width: float | None = None, with_band: bool = False) -> float:
        """Sum of squares at this latency and dead-band; keeps the solution if it is the best."""
        theta = self.theta.copy()
        theta[-1] = theta[-1] if width is None else width
        cost, theta, starts = self.solve(theta, latency, evaluations, with_band)
        if cost < self.best:
            self.best, self.theta, self.starts = cost, theta, starts
        return cost

    def best_latency(self, candidates: tuple[int, ...], guess: int | None = None) -> int:
        """Scan all candidates, or those next to a guess."""
        self.best = np.inf
        near = [c for c in candidates if guess is None or abs(c - guess) <= 1]
        costs = {lag: self.attempt(lag, 6) for lag in near}
        return min(near, key=costs.__getitem__)

    def search_dead_band(self, latency: int, span: tuple[float, float], fine: bool) -> None:
        """Scan the range, or five values about the present one, then Brent's method."""
        from scipy.optimize import minimize_scalar

        cell = (span[1] - span[0]) / 10
        grid = (
            np.linspace(*span, 11)
            if not fine
            else np.clip(self.theta[-1] + np.array([-0.6, -0.3, 0.0, 0.3, 0.6]) * cell, *span)
        )
        self.best = np.inf
        costs = [self.attempt(latency, 5, width) for width in grid]
        at, last = int(np.argmin(costs)), len(grid) - 1
        minimize_scalar(
            lambda width: self.attempt(latency, 5, width),
            method="bounded",
            bounds=(grid[max(at - 1, 0)], grid[min(at + 1, last)]),
            options={"xatol": 2e-3 * (span[1] - span[0])},
        )

    def explore(self, latency: int, with_band: bool, rounds: int = 6, crowd: int = 256) -> None:
        """Cross-entropy search about the present solution, which a gradient cannot leave: a
        dead-band makes the sum of squares rugged at the scale of the parameters' own errors."""
        count = len(self.theta) - (not with_band)
        slope = self.jacobian(self.theta, self.starts, latency)[:, :count] * self.scale[:count]
        middle = self.theta[:count] / self.scale[:count]
        spread = np.linalg.pinv(slope.T @ slope, rcond=1e-8) * 25.0 + 1e-8 * np.eye(count)
        rng = np.random.default_rng(0)
        low, high = self.low[:count] / self.scale[:count], self.high[:count] / self.scale[:count]
        self.seen = []
        for _ in range(rounds):
            tries = np.clip(rng.multivariate_normal(middle, spread, crowd), low, high)
            tries[0] = middle
            thetas = np.tile(self.theta, (crowd, 1))
            thetas[:, :count] = tries * self.scale[:count]
            costs = self._costs(thetas, latency)
            order = np.argsort(costs)
            self.seen += [(thetas, costs)]
            elite = tries[order[: crowd // 8]]
            middle, spread = elite[0], 2.0 * np.cov(elite.T) + 1e-12 * np.eye(count)
            if self.attempt_from(thetas[order[0]], latency, with_band) is not None:
                middle = self.theta[:count] / self.scale[:count]

    def plausible(self, latency: int, with_band: bool) -> tuple[np.ndarray, np.ndarray]:
        """Least and largest of each parameter among all candidates that the data do not exclude;
        with a dead-band, by the critical value of a threshold."""
        least = np.sum(self.residual(self.theta, self.starts, latency) ** 2)
        critical = _THRESHOLD if with_band else CHI2
        limit = least * (1 + critical / max(self.measured.size - len(self.theta), 1))
        thetas, costs = (np.concatenate(parts) for parts in zip(*self.seen, strict=True))
        kept = np.concatenate([thetas[costs <= limit], self.theta[None]])
        return kept.min(0), kept.max(0)

    def _costs(self, thetas: np.ndarray, latency: int) -> np.ndarray:
        """Sums of squares [N] of many candidates at once."""
        starts = jnp.asarray(self.starts[self.segment], jnp.float32)
        weight = 1.0 / jnp.asarray(self.noise[: len(self.measured)], jnp.float32)
        out = _crowd_costs(
            self._all(thetas),
            starts,
            self.target,
            self.segment,
            jnp.int32(latency),
            jnp.float32(self.timestep),
            self.substeps,
            jnp.asarray(self.measured, jnp.float32),
            weight,
        )
        return np.nan_to_num(np.asarray(out, float), nan=np.inf)

    def attempt_from(self, theta: np.ndarray, latency: int, with_band: bool) -> float | None:
        """The better cost if the gradient's way from here ends lower than the best."""
        cost, theta, starts = self.solve(theta, latency, 6, with_band)
        if cost >= self.best:
            return None
        self.best, self.theta, self.starts = cost, theta, starts
        return cost

    def start_over(self, latency: int, with_band: bool, tries: int) -> None:
        """Solve again from about the present parameters, and from the angles as they were read:
        a valley to which parameters and starts have settled together has no other way out."""
        rng, best, starts = np.random.default_rng(1), self.theta, self.starts
        for index in range(tries):
            width = 0.02 * 3.0 ** (index % 3)  # 2, 6 and 18 %
            theta = best + width * self.scale * rng.standard_normal(len(best))
            theta[-1] = theta[-1] if with_band else best[-1]
            self.starts = self.rests
            found = self.solve(np.clip(theta, self.low, self.high), latency, 12, with_band)
            if found[0] < self.best:
                (self.best, best, starts) = found
        self.theta, self.starts = best, starts

    def settle(self, latency: int, with_band: bool, last: bool) -> None:
        """Solve to the end, and take each channel's noise from what the fit leaves."""
        self.best = np.inf
        self.attempt(latency, 30)
        if with_band:
            self.attempt(latency, 30, with_band=True)
        # Without a dead-band there is next to nothing to get lost in.
        self.start_over(latency, with_band, tries=(6 if last else 10) if with_band else 2)
        if with_band and not last:
            self.explore(latency, with_band, rounds=6)
        left = self.residual(self.theta, self.starts, latency).reshape(len(self.measured), -1)
        self.noise = self.noise.copy()
        self.noise[: len(left)] *= np.maximum(np.sqrt(np.mean(left**2, -1)), 1e-6)
        if last:
            self.best = np.sum(self.residual(self.theta, self.starts, latency) ** 2)
            self.explore(latency, with_band, rounds=14 if with_band else 3)

    def dead_band_profile(self, latency: int, span: tuple[float, float]) -> tuple[float, float]:
        """Where the sum of squares, fitted anew, rises by the critical value of a threshold."""
        theta = self.theta.copy()
        least = self.solve(theta, latency, 15)[0]
        limit = least * (1 + _THRESHOLD / max(self.measured.size - theta.size, 1))
        ends = []
        for way, end in ((-1, span[0]), (1, span[1])):
            step, last = 2e-3 * (span[1] - span[0]), theta[-1]
            while way * (end - last) > 0:
                tried = float(np.clip(last + way * step, *span))
                if self.solve(np.append(theta[:-1], tried), latency, 6)[0] > limit:
                    break
                last, step = tried, 1.6 * step
            ends.append(float(np.clip(last + way * step, *span)))  # the first that is excluded
        return ends[0], ends[1]
