"""Quality of an identification: intervals, correlations, parameters at their bounds, advice."""

import dataclasses

import numpy as np
from scipy.special import stdtrit

from dexsim.core.robust_line import LEAST_GROUPS, long_run
from dexsim.identification.joint import PARAMETERS

TYPICAL = {
    "stiffness": 1.0,
    "damping": 0.05,
    "dead_band": 0.005,
    "stall_torque": 0.4,
    "no_load_speed": 10.0,
    "efficiency": 0.5,
    "encoder_bias": 0.01,
    "coulomb_friction": 0.01,
    "viscous_friction": 0.005,
    "inertia": 1e-3,
    "gravity_cos": 0.01,
    "gravity_sin": 0.01,
}
"""Sizes below which a parameter hardly matters on this kind of hand; they make relative errors."""

_ADVICE = {
    frozenset({"stiffness", "efficiency"}): "efficiency and gains enter as products: keep one fixed",
    frozenset({"stall_torque", "efficiency"}): "efficiency and stall torque enter as a product",
    frozenset({"stiffness", "inertia"}): "angles alone fix torques over inertia only: record the "
    "torque, or keep the inertia of the model",
    frozenset({"damping", "viscous_friction"}): "the drive's damping and the gear's look alike in "
    "angles: record the torque",
    frozenset({"dead_band", "coulomb_friction"}): "both hold the joint near its target: add small "
    "reversals, record the torque",
    frozenset({"stall_torque", "no_load_speed"}): "the envelope was touched at one speed only: add "
    "larger steps, some held back by hand",
}
_ALONE = {
    "stall_torque": "the drive never reached its limit: add larger steps",
    "no_load_speed": "the drive never reached its limit at speed: add larger steps",
    "encoder_bias": "angles alone cannot show the encoder's zero: run the joint against its stop",
    "dead_band": "add small reversals, record the torque",
}

NULL = 1e-4  # singular values below this share of the largest are none: the Jacobian is float32
CORRELATED, VAGUE = 0.97, 0.5
NORMAL = 1.96  # 97.5 % quantile


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
        head = f"{'parameter':18}{'value':>12}{'95 % from':>12}{'to':>12}  unit"
        rows = [
            f"{self.joint}: rmse {1e3 * self.rmse:.2f} mrad, hold-out "
            f"{1e3 * self.holdout_rmse:.2f} mrad (before {1e3 * self.holdout_rmse_before:.2f})",
            head,
        ]
        for name in self.fitted:
            low, high = self.intervals[name]
            mark = " at its bound" if name in self.at_bound else ""
            rows.append(f"{name:18}{self.values[name]:12.5g}{low:12.5g}{high:12.5g}  {PARAMETERS[name]}{mark}")
        others = ", ".join(str(lag) for lag in self.latency_plausible if lag != self.latency)
        rows.append(
            f"{'latency':18}{self.latency:12d} sub-steps of {1e3 * self.timestep:g} ms"
            + (f" (not excluded: {others})" if others else "")
        )
        return "\n".join(rows + [f"note: {note}" for note in self.notes])


def uncertainty(
    jacobian: np.ndarray, residual: np.ndarray, size: np.ndarray, segment: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float, list[np.ndarray]]:
    """Half-widths and correlations from a least-squares solution.

    Args:
      jacobian: [N, P] of the weighted residuals [N], N a multiple of the instants T (channels).
      size: [P], what counts as a relative change of 1.
      segment: [T] int, parts of the log that began at rest; residuals of one part belong together.

    Returns:
      Half of the 95 % intervals [P] (infinite for members of null directions), correlation [P, P],
      condition number, and the null directions [P] as boolean masks of their members.
    """
    relative = jacobian * size
    _, singular, right = np.linalg.svd(relative, full_matrices=False)
    known = singular > NULL * singular[0]
    null = [np.abs(v) > 0.15 * np.max(np.abs(v)) for v in right[~known]]
    inverse = (right[known].T / singular[known] ** 2) @ right[known]
    freedom = max(len(residual) - len(size), 1)
    white = inverse * np.sum(residual**2) / freedom
    score = (relative * residual[:, None]).reshape(-1, len(segment), len(size)).sum(0)
    robust = inverse @ long_run(score) @ inverse * len(residual) / freedom
    # Whichever is larger: the robust one is itself a guess and falls short in half of all cases.
    half = NORMAL * np.sqrt(np.maximum(np.diag(white), np.diag(robust)))
    half = np.maximum(half, _between_segments(relative, score, segment)) * size
    spread = np.sqrt(np.maximum(np.diag(white), 1e-300))
    correlation = white / np.outer(spread, spread)
    for members in null:
        half[members] = np.inf
        correlation[members], correlation[:, members] = np.nan, np.nan
    condition = float(singular[0] / max(singular[-1], 1e-300))
    return half, correlation, condition, null


def _between_segments(relative: np.ndarray, score: np.ndarray, segment: np.ndarray) -> np.ndarray:
    """Half of the 95 % intervals [P] by the jackknife over segments, one Newton step each.

    What the model gets wrong differs from signal to signal, which no autocorrelation shows.
    """
    rows = relative.reshape(-1, len(segment), relative.shape[1])
    parts = [np.einsum("ctp,ctq->pq", rows[:, segment == k], rows[:, segment == k]) for k in np.unique(segment)]
    count, whole = len(parts), np.sum(parts, 0)
    if count < LEAST_GROUPS:
        return np.zeros(len(whole))
    scores = [score[segment == k].sum(0) for k in np.unique(segment)]
    moved = [
        np.linalg.pinv(whole - part, rcond=NULL**2, hermitian=True) @ own
        for part, own in zip(parts, scores, strict=True)
    ]
    return stdtrit(count - 1, 0.975) * np.sqrt((count - 1) / count * np.sum(np.square(moved), 0))


def groups(
    names: tuple[str, ...], null: list[np.ndarray], correlation: np.ndarray, half: np.ndarray, size: np.ndarray
) -> tuple[tuple[str, ...], ...]:
    """Which parameters the data do not separate, or do not see."""
    sets = [tuple(n for n, m in zip(names, members, strict=True) if m) for members in null]
    inside = {name for group in sets for name in group}
    for i, first in enumerate(names):
        if first in inside:
            continue
        mates = [j for j in range(len(names)) if j != i and abs(correlation[i, j]) > CORRELATED]
        vague = half[i] > NORMAL * VAGUE * size[i]
        if vague and mates:
            sets.append(tuple(sorted({first, *(names[j] for j in mates)}, key=names.index)))
        elif vague:
            sets.append((first,))
    return tuple(dict.fromkeys(sets))


def advice(sets: tuple[tuple[str, ...], ...]) -> list[str]:
    """One line for each group."""
    notes = []
    for group in sets:
        hints = [text for pair, text in _ADVICE.items() if pair <= set(group)]
        if len(group) == 1:
            hints = [_ALONE[group[0]]] if group[0] in _ALONE else []
            text = f"{group[0]} has next to no effect on these data"
        else:
            text = f"only a combination of {', '.join(group)} is known"
        notes.append("; ".join([text, *hints]))
    return notes
