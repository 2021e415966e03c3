"""A policy in a file that needs NumPy alone: no JAX, no simulator, nothing else of this library.

    policy = PortablePolicy.load("grasp.npz")   # written by `python -m dexsim_ppo.export`
    carry = policy.initial_carry()              # at an episode's start; None where the policy has no memory
    carry, action = policy.act(carry, observation)

This module imports only NumPy and may be copied to a computer that has nothing else.

The file is a NumPy archive without pickles: `header` (JSON: task, control rate, observation layout, clip), `mean` and
`std` [n] of the observation, and `kernel_0` [in, out], `bias_0` [out] and so on for every layer. A gated recurrent unit
has `input_kernel`, `input_bias`, `recurrent_kernel` and `recurrent_bias`: reset gate, update gate, candidate.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np

FORMAT = "dexsim policy 3"


class PortablePolicy:
    """A deterministic policy.

    Args:
      header: as in the file.
      arrays: as in the file, by name.
    """

    def __init__(self, header: dict[str, Any], arrays: dict[str, np.ndarray]):
        self.header, self.arrays = header, arrays
        self.task: str = header["task"]
        self.control_rate: float = header["control_rate"]
        """Actions per second, Hz."""
        self.observation_layout: list[list[Any]] = header["observation_layout"]
        """Name, size and scale of each field of the observation, in order."""
        self._layers = sum(name.startswith("kernel_") for name in arrays)
        self._carry_size = len(arrays["recurrent_kernel"]) if "recurrent_kernel" in arrays else 0

    @classmethod
    def load(cls, path: str | Path) -> "PortablePolicy":
        """Read a file.

        Raises:
          ValueError: it is none of this format.
          OSError: it cannot be read.
        """
        with np.load(path, allow_pickle=False) as file:
            arrays = dict(file)
        header = json.loads(str(arrays.pop("header")))
        if header["format"] != FORMAT:
            raise ValueError(f"expected the format {FORMAT!r}, got {header['format']!r}")
        return cls(header, arrays)

    def initial_carry(self, *batch: int) -> np.ndarray | None:
        """The carry [*batch, m] at the start of an episode; None for a policy without memory."""
        return np.zeros((*batch, self._carry_size), np.float32) if self._carry_size else None

    def act(self, carry: np.ndarray | None, observation: np.ndarray) -> tuple[np.ndarray | None, np.ndarray]:
        """The next carry [..., m], and the action [..., A] in [-1, 1] for an observation [..., n] in SI units."""
        arrays, clip = self.arrays, self.header["clip"]
        x = np.clip((np.asarray(observation, np.float32) - arrays["mean"]) / arrays["std"], -clip, clip)
        if self._carry_size:
            carry = self._step_memory(np.asarray(carry), x)
            x = np.concatenate([x, carry], -1)
        for i in range(self._layers):
            x = x @ arrays[f"kernel_{i}"] + arrays[f"bias_{i}"]
            if i < self._layers - 1:
                x = np.where(x > 0, x, np.expm1(np.minimum(x, 0.0)))  # ELU
        return carry, np.clip(x, -1.0, 1.0)

    def _step_memory(self, carry: np.ndarray, x: np.ndarray) -> np.ndarray:
        """The carry after the normalised observation `x`."""
        arrays = self.arrays
        now = np.split(x @ arrays["input_kernel"] + arrays["input_bias"], 3, -1)
        past = np.split(carry @ arrays["recurrent_kernel"] + arrays["recurrent_bias"], 3, -1)
        # The logistic function by tanh, which does not overflow.
        reset, update = (0.5 + 0.5 * np.tanh(0.5 * (a + b)) for a, b in zip(now[:2], past[:2], strict=True))
        return update * carry + (1 - update) * np.tanh(now[2] + reset * past[2])
