"""The network of a policy's file: read, and checked before anything is computed with it."""

from typing import Any

import jax
import numpy as np

from dexsim_ppo.learner.memory import GRU, History, Memory, state_size
from dexsim_ppo.learner.networks import MLP, Layer
from dexsim_ppo.learner.running_stats import Normalizer
from dexsim_ppo.learner.types import Field, layout_size


def read_network(content: dict[str, Any], leaves: dict[str, Any]) -> tuple[tuple[Field, ...], MLP, Normalizer, Memory]:
    """The observation's layout, layers, normaliser and memory, as NumPy arrays.

    Raises:
      KeyError, TypeError, ValueError: it is not sound.
    """
    layout = tuple(Field(*field) for field in content["observation_layout"])
    _check_content(content, layout)
    layers = tuple(
        Layer(leaves[f".layers[{i}].kernel"], leaves[f".layers[{i}].bias"]) for i in range(content["layers"])
    )
    normalizer = Normalizer(leaves[".normalizer.mean"], leaves[".normalizer.std"], content["clip"])
    inputs, memory = layout_size(layout), _read_memory(content.get("memory"), leaves)
    sizes = [inputs + state_size(memory, inputs), *(layer.kernel.shape[1] for layer in layers)]
    shapes = [(layer.kernel.shape, layer.bias.shape) for layer in layers]
    wanted = [((n, m), (m,)) for n, m in zip(sizes[:-1], sizes[1:], strict=True)]
    if (
        len(leaves) != 2 * len(layers) + 2 + len(jax.tree.leaves(memory))
        or shapes != wanted
        or not normalizer.mean.shape == normalizer.std.shape == (inputs,)
    ):
        raise ValueError(f"layer shapes {shapes} for {sizes[0]} inputs")
    check_numbers(layers, normalizer, memory)
    return layout, layers, normalizer, memory


def memory_to_list(memory: Memory) -> list[Any] | None:
    """A memory's kind and size as plain data; None of a policy without."""
    if isinstance(memory, History):
        return ["history", memory.length]
    return None if memory is None else ["gru", memory.recurrent.kernel.shape[0]]


def _read_memory(content: Any, leaves: dict[str, Any]) -> Memory:
    """Raises ValueError: it is no memory, or its arrays are of other shapes."""
    if content is None:
        return None
    kind, size = content
    _check_number("size of the memory", size, 1, 4096)
    if kind == "history" and type(size) is int:
        return History(size)
    parts = [Layer(leaves[f".memory.{part}.kernel"], leaves[f".memory.{part}.bias"]) for part in ("input", "recurrent")]
    inputs = leaves[".normalizer.mean"].shape[0]
    shapes = [layer.kernel.shape + layer.bias.shape for layer in parts]
    if kind != "gru" or shapes != [(inputs, 3 * size, 3 * size), (size, 3 * size, 3 * size)]:
        raise ValueError(f"memory {str(content):.50} of shapes {shapes}")
    return GRU(*parts)


def _check_content(content: dict[str, Any], layout: tuple[Field, ...]) -> None:
    """Raises ValueError: a value of another type, or beyond what a policy of a hand can have."""
    for name, kind in (("env_config", dict), ("training", dict), ("layers", int)):
        if type(content[name]) is not kind:
            raise ValueError(f"{name} is not a {kind.__name__}")
    # No hand is run at less than one command a second, and none answers a thousand.
    for name, low, high in (("control_rate", 1.0, 1000.0), ("clip", 0.1, 1e4), ("layers", 1, 64)):
        _check_number(name, content[name], low, high)
    if content["squash"] not in ("gaussian", "tanh"):
        raise ValueError(f"squash = {str(content['squash']):.50}")
    for field in layout:
        if not isinstance(field.name, str) or type(field.size) is not int:
            raise ValueError(f"observation field {str(tuple(field)):.100}")
        _check_number(f"size of {field.name:.50}", field.size, 1, 100_000)
        if field.scale is not None:
            _check_number(f"scale of {field.name:.50}", field.scale, 1e-9, 1e9)


def _check_number(name: str, value: Any, low: float, high: float) -> None:
    if type(value) not in (int, float) or not low <= value <= high:
        raise ValueError(f"{name} = {str(value):.50}: must be a number between {low:g} and {high:g}")


def check_numbers(layers: MLP, normalizer: Normalizer, memory: Memory) -> None:
    """Raises ValueError: some number is not finite, or some observation would give an action that is not."""
    arrays = {"normalizer.mean": normalizer.mean, "normalizer.std": normalizer.std}
    if isinstance(memory, GRU):
        parts = (memory.input, memory.recurrent)
        arrays |= {f"memory[{i}]": x for i, x in enumerate(jax.tree.leaves(parts))}
    for i, layer in enumerate(layers):
        arrays |= {f"layers[{i}].kernel": layer.kernel, f"layers[{i}].bias": layer.bias}
    for name, array in arrays.items():
        if array.dtype != np.float32 or not np.all(np.isfinite(array)):
            raise ValueError(f"{name} holds what is not a finite float32")
    if not np.all(np.asarray(normalizer.std) >= 1e-12):
        raise ValueError("normalizer.std is not positive")
    largest = np.full(normalizer.mean.shape, float(normalizer.clip))
    if isinstance(memory, History):
        largest = np.tile(largest, memory.length + 1)
    elif memory is not None:
        # Gates saturate, but an infinite number times a closed gate is none.
        units = np.ones(memory.recurrent.kernel.shape[0])
        for part, inputs in ((memory.input, largest), (memory.recurrent, units)):
            if np.max(inputs @ np.abs(np.asarray(part.kernel, float)) + np.abs(np.asarray(part.bias, float))) > 1e30:
                raise ValueError("the weights of its memory are so large that it overflows")
        largest = np.append(largest, units)
    for layer in layers:  # The activation does not go beyond its input or 1.
        kernel, bias = np.asarray(layer.kernel, float), np.asarray(layer.bias, float)
        largest = np.maximum(largest @ np.abs(kernel) + np.abs(bias), 1.0)
        if largest.max(initial=0.0) > 1e30:
            raise ValueError("its weights are so large that actions overflow")
