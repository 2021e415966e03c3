"""Quality of an identification: intervals, correlations, groups that the data do not separate."""

import numpy as np
from scipy.special import stdtrit

from dexsim.core.robust_line import LEAST_GROUPS, long_run

_NULL = 1e-4  # singular values below this share of the largest are none: the Jacobian is float32
_CORRELATED, _VAGUE = 0.97, 0.5
_NORMAL = 1.96  # 97.5 % quantile


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
    known = singular > _NULL * singular[0]
    null = [np.abs(v) > 0.15 * np.max(np.abs(v)) for v in right[~known]]
    inverse = (right[known].T / singular[known] ** 2) @ right[known]
    freedom = max(len(residual) - len(size), 1)
    white = inverse * np.sum(residual**2) / freedom
    score = (relative * residual[:, None]).reshape(-1, len(segment), len(size)).sum(0)
    robust = inverse @ long_run(score) @ inverse * len(residual) / freedom
    # Whichever is larger: the robust one is itself a guess and falls short in half of all cases.
    half = _NORMAL * np.sqrt(np.maximum(np.diag(white), np.diag(robust)))
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
        np.linalg.pinv(whole - part, rcond=_NULL**2, hermitian=True) @ own
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
        mates = [j for j in range(len(names)) if j != i and abs(correlation[i, j]) > _CORRELATED]
        vague = half[i] > _NORMAL * _VAGUE * size[i]
        if vague and mates:
            sets.append(tuple(sorted({first, *(names[j] for j in mates)}, key=names.index)))
        elif vague:
            sets.append((first,))
    return tuple(dict.fromkeys(sets))
