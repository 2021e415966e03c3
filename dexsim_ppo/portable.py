"""A policy in a file that needs NumPy alone: no JAX, no simulator, nothing else of this library.

    policy = PortablePolicy.load("grasp.npz")   # written by `python -m dexsim_ppo.export`
    action = policy(observation)

    memory = policy.begin()                     # one that was trained with a memory: at an episode's start
    memory, action = policy.act(memory, observation)

This module imports only NumPy and may be copied to a computer that has nothing else.

The file is a NumPy archive without pickles: `header` (JSON: task, control rate, observation layout, squashing, clip),
`mean` and `std` [n] of the observation, and `kernel_0` [in, out], `bias_0` [out] and so on for every layer. A gated
recurrent unit has `input_kernel`, `input_bias`, `recurrent_kernel` and `recurrent_bias`: reset gate, update gate,
candidate.
"""

import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

FORMAT = "dexsim policy 1"
UNIT = ("input_kernel", "input_bias", "recurrent_kernel", "recurrent_bias")


class PortablePolicy:
    """A deterministic policy.

    Args:
      header: as in the file.
      mean, std: [n] of the observation.
      layers: kernels [in, out] and biases [out].
      unit: kernel and bias of a gated recurrent unit's input, and of its state.

    Raises:
      ValueError: shapes that do not fit, or numbers that are not finite.
    """

    def __init__(
        self,
        header: dict[str, Any],
        mean: np.ndarray,
        std: np.ndarray,
        layers: list[tuple[np.ndarray, np.ndarray]],
        unit: tuple[np.ndarray, ...] = (),
    ):
        kind, size = header.get("memory") or (None, 0)
        self._kept = len(mean) * size if kind == "history" else size
        sizes = [len(mean) + self._kept, *(len(bias) for _, bias in layers)]
        shapes = [kernel.shape for kernel, _ in layers]
        if not layers or shapes != list(zip(sizes[:-1], sizes[1:], strict=True)) or mean.shape != std.shape:
            raise ValueError(f"layers of shapes {shapes} for {len(mean)} observations")
        wanted = [(len(mean), 3 * size), (3 * size,), (size, 3 * size), (3 * size,)] if kind == "gru" else []
        if kind not in (None, "history", "gru") or [x.shape for x in unit] != wanted:
            raise ValueError(f"a memory {kind!r} of shapes {[x.shape for x in unit]}")
        if len(mean) != sum(size for _, size, _ in header["observation_layout"]):
            raise ValueError(f"{len(mean)} observations, and a layout of other size")
        if not all(np.isfinite(x).all() for x in (mean, std, *unit, *(x for layer in layers for x in layer))):
            raise ValueError("numbers that are not finite")
        self.task: str = header["task"]
        self.control_rate: float = header["control_rate"]
        """Actions per second, Hz."""
        self.observation_layout: list[list[Any]] = header["observation_layout"]
        """Name, size and scale of each field of the observation, in order."""
        self.header = header
        self._mean, self._std, self._layers, self._unit = mean, std, layers, unit

    @classmethod
    def load(cls, path: str | Path) -> "PortablePolicy":
        """Read a file.

        Raises:
          ValueError: it is none of this format, or unsound.
          OSError: it cannot be read.
        """
        try:
            with np.load(path, allow_pickle=False) as file:
                header = json.loads(str(file["header"]))
                if header.get("format") != FORMAT:
                    raise ValueError(f"its format is {str(header.get('format')):.50}, not {FORMAT}")
                layers = [(file[f"kernel_{i}"], file[f"bias_{i}"]) for i in range(header["layers"])]
                unit = tuple(file[name] for name in UNIT if name in file)
                return cls(header, file["mean"], file["std"], layers, unit)
        except (KeyError, TypeError, ValueError, AttributeError, zipfile.BadZipFile) as error:
            raise ValueError(f"{path}: is not a policy of this format ({error})") from None

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Action [..., A] in [-1, 1] for an actor observation [..., n] in SI units.

        Raises:
          ValueError: the policy has a memory.
        """
        if self._kept:
            raise ValueError("this policy has a memory: use begin and act")
        return self.act(None, observation)[1]

    def begin(self, *batch: int) -> np.ndarray | None:
        """What it remembers [*batch, m] at the start of an episode; None if it has no memory."""
        return np.zeros((*batch, self._kept), np.float32) if self._kept else None

    def act(self, memory: np.ndarray | None, observation: np.ndarray) -> tuple[np.ndarray | None, np.ndarray]:
        """Memory after this observation [..., n], and action [..., A]: for policies with or without memory."""
        clip = self.header["clip"]
        x = np.clip((np.asarray(observation, np.float32) - self._mean) / self._std, -clip, clip)
        if memory is not None and self._unit:
            memory = self._recur(np.asarray(memory), x)
            x = np.concatenate([x, memory], -1)
        elif memory is not None:
            x = np.concatenate([x, memory], -1)
            memory = x[..., : self._kept]
        for i, (kernel, bias) in enumerate(self._layers):
            x = x @ kernel + bias
            if i < len(self._layers) - 1:
                x = np.where(x > 0, x, np.expm1(np.minimum(x, 0.0)))  # ELU
        return memory, np.tanh(x) if self.header["squash"] == "tanh" else np.clip(x, -1.0, 1.0)

    def _recur(self, state: np.ndarray, x: np.ndarray) -> np.ndarray:
        """State of the gated recurrent unit after the normalised observation `x`."""
        kernel, bias, state_kernel, state_bias = self._unit
        given, past = np.split(x @ kernel + bias, 3, -1), np.split(state @ state_kernel + state_bias, 3, -1)
        # The logistic function by tanh, which does not overflow.
        reset, update = (0.5 + 0.5 * np.tanh(0.5 * (a + b)) for a, b in zip(given[:2], past[:2], strict=True))
        return update * state + (1 - update) * np.tanh(given[2] + reset * past[2])
