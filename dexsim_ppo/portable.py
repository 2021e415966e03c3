"""Policies without JAX: reads and runs a policy's file with NumPy and msgpack alone.

    policy = PortablePolicy.load("runs/grasp/best.msgpack")
    carry = policy.initial_carry()              # at an episode's start; None where the policy has no memory
    carry, action = policy.act(carry, observation)

This module imports nothing else of this library and may be copied to a computer that has nothing else.

The format of policies and checkpoints:

    offset  size  content
    0       6     magic, b"DEXSIM"
    6       2     format version, little-endian like all integers
    8       8     length of the header, n
    16      32    SHA-256 of all other bytes
    48      n     header: msgpack map with "kind", "task", "content" (what the kind needs) and
                  "leaves" (path, dtype, shape, PRNG implementation)
    48 + n        payload: the leaves' bytes in C order, one after another

A policy's leaves are `mean` and `std` [n] of the observation, and `kernel_0` [in, out], `bias_0` [out] and so on for
every layer. A gated recurrent unit has `input_kernel`, `input_bias`, `recurrent_kernel` and `recurrent_bias`: reset
gate, update gate, candidate.
"""

import hashlib
import math
import struct
from pathlib import Path
from typing import Any

import msgpack
import numpy as np

MAGIC = b"DEXSIM"
FORMAT_VERSION = 2
PREFIX = struct.Struct("<6sHQ")
_START = PREFIX.size + hashlib.sha256().digest_size


class PortablePolicy:
    """A deterministic policy.

    Args:
      task: what it was trained for.
      header: what its file says beside the numbers.
      arrays: the numbers by name.
    """

    def __init__(self, task: str, header: dict[str, Any], arrays: dict[str, np.ndarray]):
        self.task, self.header, self.arrays = task, header, arrays
        self.control_rate: float = header["control_rate"]
        """Actions per second, Hz."""
        self.observation_layout: list[list[Any]] = header["observation_layout"]
        """Name, size and scale of each field of the observation, in order."""
        self._layers = sum(name.startswith("kernel_") for name in arrays)
        self._carry_size = len(arrays["recurrent_kernel"]) if "recurrent_kernel" in arrays else 0

    @classmethod
    def load(cls, path: str | Path) -> "PortablePolicy":
        """Read a file; errors as of `read_file`."""
        file, leaves = read_file(path, "policy")
        # The path of a dictionary's leaf is ['mean'].
        return cls(file["task"], file["content"], {path.strip("[']"): array for path, array in leaves.items()})

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


def read_file(path: str | Path, kind: str) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The header of a file, and its arrays by path. Nothing is executed.

    Raises:
      ValueError: not of this format or version, cut short, altered, or of another kind.
      OSError: it cannot be read.
    """
    data = memoryview(Path(path).read_bytes())
    if bytes(data[: len(MAGIC)]) != MAGIC:
        raise ValueError("is not a dexsim checkpoint or policy")
    if len(data) < _START:
        raise ValueError("is cut short")
    _, version, size = PREFIX.unpack_from(data)
    if version != FORMAT_VERSION:
        raise ValueError(f"has format version {version}, expected {FORMAT_VERSION}")
    if digest(data[: PREFIX.size], data[_START:]) != bytes(data[PREFIX.size : _START]):
        raise ValueError("is cut short or damaged (its checksum is wrong)")
    header, offset = msgpack.unpackb(data[_START : _START + size]), _START + size
    if header["kind"] != kind:
        raise ValueError(f"is a {header['kind']!r} file, not a {kind!r} file")
    arrays = {}
    for leaf in header["leaves"]:
        array = np.frombuffer(data, leaf["dtype"], math.prod(leaf["shape"]), offset).reshape(leaf["shape"])
        arrays[leaf["path"]], offset = array, offset + array.nbytes
    return header, arrays


def digest(*parts: Any) -> bytes:
    """SHA-256 of these bytes, one after another."""
    total = hashlib.sha256()
    for part in parts:
        total.update(part)
    return total.digest()
