"""Episodes as they are drawn, in one small file, which the live view shows without simulating them.

An .npz: `header` is JSON, the others are the arrays of `Snapshot`, one episode after another along the first axis. Real
numbers are float16, which is 1 mrad at 1 rad, 0.1 mm at 0.1 m and 1 mN at 1 N.
"""

import dataclasses
import io
import json
import operator
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dexsim.core.files import write_atomic
from dexsim.errors import DexsimError
from dexsim.hand.description import Hand
from dexsim.hand.load import load_hand
from dexsim.hand.source import record_of, recorded_hand
from dexsim.render.snapshot import Snapshot


@dataclasses.dataclass(frozen=True, kw_only=True)
class Episodes:
    """Recorded episodes of one task and hand."""

    task: str
    hand: Hand
    period: float
    """Time between two snapshots, s."""
    kinds: tuple[str, ...]
    """Kinds of the object's primitives [K]."""
    snapshots: Sequence[Snapshot]
    """Of each episode, stacked along its ticks."""


def write_episodes(path: Path, episodes: Episodes) -> None:
    """Write a file, whole or not at all."""
    header = {
        "task": episodes.task,
        "hand": record_of(episodes.hand),
        "period": episodes.period,
        "kinds": episodes.kinds,
        "lengths": [len(snapshot.joint_position) for snapshot in episodes.snapshots],
    }
    arrays: dict[str, np.ndarray] = {"header": np.array(json.dumps(header))}
    for name, first in vars(episodes.snapshots[0]).items():
        if first is not None:
            whole = np.concatenate([getattr(snapshot, name) for snapshot in episodes.snapshots])
            arrays[name] = whole.astype(np.float16) if whole.dtype.kind == "f" else whole
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **arrays)
    write_atomic(path, [buffer.getbuffer()])


def read_episodes(path: Path, hand: str = "") -> Episodes:
    """Read a file; `hand` is the TOML of its hand, where that has moved.

    Raises:
      DexsimError: it is no such file.
      ConfigError: the hand is another one than was recorded.
      OSError: it cannot be read.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays: dict[str, Any] = dict(file)
        header = json.loads(str(arrays.pop("header")))
        arrays = {name: x.astype(np.float32) if x.dtype == np.float16 else x for name, x in arrays.items()}
        whole, ends = Snapshot(**arrays), np.cumsum(header["lengths"])
        parts = [slice(a, b) for a, b in zip([0, *ends], ends, strict=False)]
        snapshots = [whole.map(operator.itemgetter(part)) for part in parts]
        task, period, kinds = header["task"], header["period"], tuple(header["kinds"])
    except (KeyError, TypeError, ValueError, EOFError) as error:
        raise DexsimError(f"{path}: no recorded episodes: {error}") from None
    recorded = recorded_hand(header["hand"], hand, f"{path}") or load_hand()
    return Episodes(task=task, hand=recorded, period=period, kinds=kinds, snapshots=snapshots)
