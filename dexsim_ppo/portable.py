"""A policy in a file that needs NumPy alone: no JAX, no simulator, nothing else of this library.

    policy = PortablePolicy.load("grasp.npz")   # written by `python -m dexsim_ppo.export`
    action = policy(observation)

This module imports only NumPy and may be copied to a computer that has nothing else.

The file is a NumPy archive without pickles: `header` (JSON: task, control rate, observation layout, squashing, clip),
`mean` and `std` [n] of the observation, and `kernel_0` [in, out], `bias_0` [out] and so on for every layer.
"""

import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

FORMAT = "dexsim policy 1"


class PortablePolicy:
    """A deterministic policy.

    Args:
      header: as in the file.
      mean, std: [n] of the observation.
      layers: kernels [in, out] and biases [out].

    Raises:
      ValueError: shapes that do not fit, or numbers that are not finite.
    """

    def __init__(
        self, header: dict[str, Any], mean: np.ndarray, std: np.ndarray, layers: list[tuple[np.ndarray, np.ndarray]]
    ):
        sizes = [len(mean), *(len(bias) for _, bias in layers)]
        shapes = [kernel.shape for kernel, _ in layers]
        if not layers or shapes != list(zip(sizes[:-1], sizes[1:], strict=True)) or mean.shape != std.shape:
            raise ValueError(f"layers of shapes {shapes} for {len(mean)} observations")
        if sizes[0] != sum(size for _, size, _ in header["observation_layout"]):
            raise ValueError(f"{sizes[0]} observations, and a layout of other size")
        if not all(np.isfinite(x).all() for x in (mean, std, *(x for layer in layers for x in layer))):
            raise ValueError("numbers that are not finite")
        self.task: str = header["task"]
        self.control_rate: float = header["control_rate"]
        """Actions per second, Hz."""
        self.observation_layout: list[list[Any]] = header["observation_layout"]
        """Name, size and scale of each field of the observation, in order."""
        self.header = header
        self._mean, self._std, self._layers = mean, std, layers

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
                return cls(header, file["mean"], file["std"], layers)
        except (KeyError, TypeError, ValueError, AttributeError, zipfile.BadZipFile) as error:
            raise ValueError(f"{path}: is not a policy of this format ({error})") from None

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Action [..., A] in [-1, 1] for an actor observation [..., n] in SI units."""
        clip = self.header["clip"]
        x = np.clip((np.asarray(observation, np.float32) - self._mean) / self._std, -clip, clip)
        for i, (kernel, bias) in enumerate(self._layers):
            x = x @ kernel + bias
            if i < len(self._layers) - 1:
                x = np.where(x > 0, x, np.expm1(np.minimum(x, 0.0)))  # ELU
        return np.tanh(x) if self.header["squash"] == "tanh" else np.clip(x, -1.0, 1.0)
