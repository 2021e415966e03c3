"""What an environment's compiled program depends on, as one hash."""

import hashlib
import json
from pathlib import Path
from typing import Any

import jax
import numpy as np

from dexsim.core.config import to_dict
from dexsim.core.files import python_sources

_PACKAGE = Path(__file__).resolve().parents[1]


def fingerprint(env: Any) -> str | None:
    """A hash that changes with the environment's settings, hand, start states and this package's sources.

    None where that is not all of it: a task of the user's own, whose sources may be anywhere, and meshes.
    """
    ours = all(type(part).__module__.partition(".")[0] == "dexsim" for part in (env, env.task))
    if not ours or env.config.objects.mesh:
        return None
    digest = hashlib.sha256(json.dumps([env.name, env.backend, to_dict(env.config)]).encode())
    for path in (*python_sources(_PACKAGE), env.hand.model_path):
        digest.update(path.read_bytes())
    for leaf in jax.tree.leaves((env.pool, env.hand.taxel_position, env.hand.taxel_normal, env.hand.taxel_area)):
        digest.update(np.ascontiguousarray(leaf).data)
    return digest.hexdigest()
