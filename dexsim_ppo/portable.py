"""A policy in a file that needs NumPy alone: no JAX, no simulator, nothing else of this library.

    policy = PortablePolicy.load("grasp.npz")   # written by `python -m dexsim_ppo.export`
    carry = policy.initial_carry()              # at an episode's start; None where the policy has no memory
    carry, action = policy.act(carry, observation)

This module imports only NumPy and may be copied to a computer that has nothing else.

The file is a NumPy archive without pickles: `header` (JSON: task, control rate, observation layout, squashing, clip),
`mean` and `std` [n] of the observation, and `kernel_0` [in, out], `bias_0` [out] and so on for every layer. A gated
recurrent unit has `input_kernel`, `input_bias`, `recurrent_kernel` and `recurrent_bias`: reset gate, update gate,
candidate.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np

FORMAT = "dexsim policy 1"
LARGEST = 2**28  # bytes of all arrays; a small archive may hold a thousand times its size
UNIT = ("input_kernel", "input_bias", "recurrent_kernel", "recurrent_bias")


def check_header(header: Any) -> None:
    """Raises ValueError: it lacks something, or has it of another type or beyond what a policy of a hand can have."""
    if not isinstance(header, dict) or header.get("format") != FORMAT:
        raise ValueError(f"its header is not of the format {FORMAT}")
    numbers: dict[str, Any] = {name: header.get(name) for name in ("control_rate", "clip")}
    limits = {"control_rate": (1.0, 1000.0), "clip": (0.1, 1e4), "size of the memory": (1, 4096)}
    layout, memory = header.get("observation_layout"), header.get("memory")
    if not isinstance(layout, list) or not all(
        isinstance(field, list)
        and [type(part) for part in field[:2]] == [str, int]
        and len(field) == 3
        and field[1] > 0
        and (field[2] is None or type(field[2]) in (int, float))
        for field in layout
    ):
        raise ValueError(f"observation_layout = {str(layout):.100}")
    if memory is not None:
        if not isinstance(memory, list) or len(memory) != 2 or type(memory[1]) is not int:
            raise ValueError(f"memory = {str(memory):.100}")
        numbers["size of the memory"] = memory[1]
    for name, value in numbers.items():
        low, high = limits[name]
        if type(value) not in (int, float) or not low <= value <= high:
            raise ValueError(f"{name} = {str(value):.50}: must be a number between {low:g} and {high:g}")
    if not isinstance(header.get("task"), str) or header.get("squash") not in ("gaussian", "tanh"):
        raise ValueError(f"task = {str(header.get('task')):.50}, squash = {str(header.get('squash')):.50}")


def _bound(inputs: np.ndarray, kernel: np.ndarray, bias: np.ndarray) -> np.ndarray:
    """Largest size of a layer's sums for inputs of at most this size."""
    return inputs @ np.abs(kernel.astype(float)) + np.abs(bias.astype(float))


class PortablePolicy:
    """A deterministic policy.

    Args:
      header: as in the file.
      mean, std: [n] of the observation.
      layers: kernels [in, out] and biases [out].
      unit: kernel and bias of a gated recurrent unit's input, and of its state.

    Raises:
      ValueError: a header that makes no sense, shapes that do not fit, or numbers with which actions are not finite.
    """

    def __init__(
        self,
        header: dict[str, Any],
        mean: np.ndarray,
        std: np.ndarray,
        layers: list[tuple[np.ndarray, np.ndarray]],
        unit: tuple[np.ndarray, ...] = (),
    ):
        check_header(header)
        kind, size = header.get("memory") or (None, 0)
        self._carry_size = len(mean) * size if kind == "history" else size
        sizes = [len(mean) + self._carry_size, *(len(bias) for _, bias in layers)]
        shapes = [kernel.shape for kernel, _ in layers]
        if not layers or shapes != list(zip(sizes[:-1], sizes[1:], strict=True)) or mean.shape != std.shape:
            raise ValueError(f"layers of shapes {shapes} for {len(mean)} observations")
        wanted = [(len(mean), 3 * size), (3 * size,), (size, 3 * size), (3 * size,)] if kind == "gru" else []
        if kind not in (None, "history", "gru") or [x.shape for x in unit] != wanted:
            raise ValueError(f"a memory {kind!r} of shapes {[x.shape for x in unit]}")
        if len(mean) != sum(size for _, size, _ in header["observation_layout"]):
            raise ValueError(f"{len(mean)} observations, and a layout of other size")
        arrays = (mean, std, *unit, *(x for layer in layers for x in layer))
        if not all(x.dtype == np.float32 and np.isfinite(x).all() for x in arrays):
            raise ValueError("numbers that are not finite float32")
        if not (std >= 1e-12).all():
            raise ValueError("deviations of the observation that are not positive")
        self._check_bounds(header["clip"], kind, size, layers, unit)
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
            with open(path, "rb") as file:  # NumPy takes whatever is no archive for a pickle.
                if file.read(4) != b"PK\3\4":
                    raise ValueError("it is no archive of NumPy")
            with np.load(path, allow_pickle=False) as file:
                if sum(member.file_size for member in file.zip.infolist()) > LARGEST:
                    raise ValueError(f"its arrays have more than {LARGEST >> 20} MiB")
                header = json.loads(str(file["header"]))
                if header.get("format") != FORMAT:
                    raise ValueError(f"its format is {str(header.get('format')):.50}, not {FORMAT}")
                layers = [(file[f"kernel_{i}"], file[f"bias_{i}"]) for i in range(header["layers"])]
                unit = tuple(file[name] for name in UNIT if name in file)
                return cls(header, file["mean"], file["std"], layers, unit)
        except OSError:
            raise
        except Exception as error:  # An archive may be damaged in more ways than NumPy and zipfile have types for.
            raise ValueError(f"{path}: is not a policy of this format ({' '.join(str(error).split()):.200})") from None

    def initial_carry(self, *batch: int) -> np.ndarray | None:
        """The carry [*batch, m] at the start of an episode; None for a policy without memory."""
        return np.zeros((*batch, self._carry_size), np.float32) if self._carry_size else None

    def act(self, carry: np.ndarray | None, observation: np.ndarray) -> tuple[np.ndarray | None, np.ndarray]:
        """The next carry [..., m], and the action [..., A] in [-1, 1] for an observation [..., n] in SI units.

        Raises:
          ValueError: the observation has another size, or the carry is not that of this policy and batch.
        """
        size, shape = self._mean.size, np.shape(observation)
        if shape[-1:] != (size,):
            raise ValueError(f"the policy observes {size} values, [..., {size}]; the observation has the shape {shape}")
        expected = (*shape[:-1], self._carry_size) if self._carry_size else None
        if (given := None if carry is None else np.shape(carry)) != expected:
            raise ValueError(f"expected a carry of the shape {expected}, got {given}: begin with initial_carry()")
        clip = self.header["clip"]
        x = np.clip((np.asarray(observation, np.float32) - self._mean) / self._std, -clip, clip)
        if carry is not None and self._unit:
            carry = self._recur(np.asarray(carry), x)
            x = np.concatenate([x, carry], -1)
        elif carry is not None:
            x = np.concatenate([x, carry], -1)
            carry = x[..., : self._carry_size]
        for i, (kernel, bias) in enumerate(self._layers):
            x = x @ kernel + bias
            if i < len(self._layers) - 1:
                x = np.where(x > 0, x, np.expm1(np.minimum(x, 0.0)))  # ELU
        return carry, np.tanh(x) if self.header["squash"] == "tanh" else np.clip(x, -1.0, 1.0)

    @staticmethod
    def _check_bounds(clip: float, kind: str | None, size: int, layers: list, unit: tuple) -> None:
        """Raises ValueError: some observation would give an action that is not finite."""
        seen = np.full(len(unit[0]) if unit else len(layers[0][0]), float(clip))
        parts = [(seen, *unit[:2]), (np.ones(size), *unit[2:])] if unit else []
        largest = np.append(seen, np.ones(size)) if unit else seen
        for kernel, bias in layers:
            parts.append((largest, kernel, bias))
            # The activation does not go beyond its input or 1.
            largest = np.maximum(_bound(largest, kernel, bias), 1.0)
        if max(_bound(*part).max(initial=0.0) for part in parts) > 1e30:
            raise ValueError("weights so large that actions overflow")

    def _recur(self, state: np.ndarray, x: np.ndarray) -> np.ndarray:
        """State of the gated recurrent unit after the normalised observation `x`."""
        kernel, bias, state_kernel, state_bias = self._unit
        given, past = np.split(x @ kernel + bias, 3, -1), np.split(state @ state_kernel + state_bias, 3, -1)
        # The logistic function by tanh, which does not overflow.
        reset, update = (0.5 + 0.5 * np.tanh(0.5 * (a + b)) for a, b in zip(given[:2], past[:2], strict=True))
        return update * state + (1 - update) * np.tanh(given[2] + reset * past[2])
