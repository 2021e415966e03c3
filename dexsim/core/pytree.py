"""Dataclasses as pytrees, and a choice between two of them."""

import dataclasses
import inspect
from typing import Any, TypeVar, dataclass_transform

import jax
import jax.numpy as jnp
import numpy as np

Array = jax.Array | np.ndarray
"""An array on the device or on the host."""


def align(x: Array, like: Array) -> jax.Array:
    """`x` with leading axes of length one, as many as it needs to broadcast against `like`."""
    return jnp.expand_dims(x, tuple(range(like.ndim - x.ndim)))


def choose(done: jax.Array, new: Any, old: Any) -> Any:
    """`new` if `done` [], else `old`: two trees of one structure, random keys included."""
    return jax.tree.map(lambda new, old: jnp.where(done, new, old), new, old)


T = TypeVar("T")


def static(**kwargs: Any) -> Any:
    """A field that is part of the tree's structure: hashable and never traced."""
    return dataclasses.field(metadata={"static": True}, **kwargs)


def leaf(text: str, **kwargs: Any) -> Any:
    """A field with its shape, unit and meaning, which `help` shows."""
    return dataclasses.field(metadata={"text": text}, **kwargs)


@dataclass_transform(frozen_default=True, field_specifiers=(static, leaf, dataclasses.field))
def pytree_dataclass(cls: type[T]) -> type[T]:
    """A frozen dataclass whose fields are pytree children, except those marked `static()`; its docstring lists those
    that are a `leaf()`."""
    cls = dataclasses.dataclass(frozen=True)(cls)
    leaves = [field for field in dataclasses.fields(cls) if "text" in field.metadata]  # type: ignore[arg-type]
    if leaves:
        lines = [f"  {field.name}: {field.metadata['text']}" for field in leaves]
        cls.__doc__ = "\n".join([inspect.cleandoc(cls.__doc__ or ""), "", "Attributes:", *lines])
    return jax.tree_util.register_dataclass(cls)
