"""Configuration: frozen dataclasses with a unit and a range on each number.

The same dataclasses are the command line (tyro), the checkpoint header and the documentation.
"""

import ast
import contextlib
import dataclasses
import functools
import inspect
import itertools
import json
import math
import textwrap
import types
import typing
from collections.abc import Collection, Iterable
from typing import Annotated, Any, TypeVar

from dexsim.errors import ConfigError

T = TypeVar("T")
Range = Annotated[tuple[float, float], "low and high, in order"]
"""The type of a field that is a range (low, high)."""


def setting(
    default: Any = dataclasses.MISSING,
    *,
    unit: str = "",
    low: float = -math.inf,
    high: float = math.inf,
    choices: Collection[str] | None = None,
    nominal: float | None = None,
) -> Any:
    """A configuration field with its unit and allowed range, checked by `Config`.

    Numbers inside a tuple are each held to the range. `nominal` is the value that a range is drawn about.
    """
    metadata = {"unit": unit, "low": low, "high": high, "choices": choices, "nominal": nominal}
    return dataclasses.field(default=default, metadata=metadata)


class _Documented(type):
    """The type of classes whose docstrings list their fields, for `help()`, notebooks and command lines alike."""

    @property
    def __doc__(cls) -> str:  # type: ignore[override]
        # To read the sources at import would take longer than the rest of it: `dataclass` asks before it sets this.
        return _document(cls) if "__match_args__" in vars(cls) else vars(cls).get("__doc__") or cls.__name__


@functools.cache
def _document(cls: Any) -> str:
    """The docstring as written, then each field with its text, unit and range."""
    texts: dict[str, str] = {}
    for base in reversed(cls.__mro__[:-1]):
        with contextlib.suppress(OSError, TypeError):  # of a class typed into an interpreter, or not written in Python
            (parsed,) = ast.parse(textwrap.dedent(inspect.getsource(base))).body
            for field, text in itertools.pairwise(parsed.body):  # type: ignore[attr-defined]
                if (
                    isinstance(field, ast.AnnAssign)
                    and isinstance(text, ast.Expr)
                    and isinstance(text.value, ast.Constant)
                ):
                    texts[ast.unparse(field.target)] = " ".join(str(text.value.value).split())
    lines = [
        f"  {field.name}: {texts[field.name]}{_limits(field)}"
        for field in dataclasses.fields(cls)
        if field.name in texts
    ]
    own = inspect.cleandoc(vars(cls).get("__doc__") or cls.__name__)
    return "\n".join([own, "", "Attributes:", *lines]) if lines else own


def _limits(field: Any) -> str:
    """Unit and range of a setting in brackets, as far as it has them."""
    told, (unit, low, high) = list[str](), (field.metadata.get(key) for key in ("unit", "low", "high"))
    if unit and unit != "1":
        told.append(unit)
    if low is not None and math.isfinite(low):
        told.append(f"{low:g} to {high:g}" if math.isfinite(high) else f"{low:g} or more")
    return f" [{', '.join(told)}]" if told else ""


class Config(metaclass=_Documented):
    """Base of configuration dataclasses: every field is checked against its type and its `setting` when one is made.

    Lists become tuples and NumPy's numbers Python's, as a file would give them back. A subclass with checks of its own
    extends `__post_init__` and calls this one first.
    """

    def __post_init__(self) -> None:
        """Raises ConfigError: names the class, the field, the value, and its type or the unit and the range."""
        cls: Any = type(self)
        for field in dataclasses.fields(cls):
            where = f"{cls.__name__}.{field.name}"
            value = _convert(_hints(cls)[field.name], getattr(self, field.name), where, field.metadata)
            object.__setattr__(self, field.name, value)


_hints = functools.cache(functools.partial(typing.get_type_hints, include_extras=True))


@dataclasses.dataclass(frozen=True)
class NoSettings:
    """The configuration of an environment that has none."""


def to_dict(config: Any) -> Any:
    """A config dataclass as nested plain dicts and lists (JSON and msgpack friendly)."""
    if dataclasses.is_dataclass(config):
        return {field.name: to_dict(getattr(config, field.name)) for field in dataclasses.fields(config)}
    return [to_dict(item) for item in config] if isinstance(config, (tuple, list)) else config


def from_dict(cls: type[T], data: dict[str, Any]) -> T:
    """Rebuild a config dataclass from `to_dict`'s output; fields left out keep their default. Raises ConfigError: an
    unknown field, or a value of the wrong type or out of range."""
    if not isinstance(data, dict):
        raise ConfigError(f"{cls.__name__}: expected a table of fields, got {type(data).__name__}")
    fields = {field.name: field for field in dataclasses.fields(cls)}  # type: ignore[arg-type]
    for name in data:
        if name not in fields:
            raise ConfigError(f"{cls.__name__} has no field {name!r:.80}")
    for name, field in fields.items():
        if name not in data and field.default is field.default_factory is dataclasses.MISSING:
            raise ConfigError(f"{cls.__name__}.{name} is missing")
    return cls(**data)


@contextlib.contextmanager
def naming_file(path: object) -> typing.Iterator[None]:
    """Errors from within begin with the name of the file that the configuration is read from."""
    try:
        yield
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None


def override(data: dict[str, Any], settings: Iterable[str]) -> dict[str, Any]:
    """`to_dict`'s output with some fields replaced, each as "object.extremes=1" or "edge=[0.05, 0.06]": JSON, Python's
    literals (which have .006 and 5.), or words without quotes. `from_dict` tells whether they fit. Raises ConfigError:
    a setting without a name or a value."""
    for entry in settings:
        path, _, text = entry.partition("=")
        if not (path and text):
            raise ConfigError(f"{entry!r}: expected NAME=VALUE, such as randomization.scale=0.5")
        change: Any = _literal(text)
        for name in reversed(path.split(".")):
            change = {name: change}
        data = _merge(data, change)
    return data


def _literal(text: str) -> Any:
    for parse in (json.loads, ast.literal_eval):
        with contextlib.suppress(ValueError, SyntaxError):
            return parse(text)
    return text


def flat(data: Any, path: str = "") -> dict[str, Any]:
    """`to_dict`'s output as one mapping from path ("objects.mass") to value."""
    if not isinstance(data, dict):
        return {path: data}
    return {k: v for name, value in data.items() for k, v in flat(value, f"{path}.{name}" if path else name).items()}


def _merge(data: Any, change: dict[str, Any]) -> dict[str, Any]:
    before = data if isinstance(data, dict) else {}
    return before | {
        name: _merge(before.get(name), value) if isinstance(value, dict) else value for name, value in change.items()
    }


def _convert(hint: Any, value: Any, where: str, metadata: Any) -> Any:
    """A value as its type has it: tuples for lists, Python's numbers for NumPy's, configurations for tables. It, or
    each item of a tuple, is held to the choices and the range of its `setting`."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if hasattr(value, "tolist"):
        value = value.tolist()
    if origin is Annotated:
        value = _convert(arguments[0], value, where, metadata)
        if hint == Range and value[0] > value[1]:
            low, high = value
            raise ConfigError(f"{where} = ({low:.10g}, {high:.10g}): the first must not exceed the second")
        return value
    if isinstance(hint, type) and dataclasses.is_dataclass(hint):
        return value if isinstance(value, hint) else from_dict(hint, value)
    if origin in (typing.Union, types.UnionType):
        options = [argument for argument in arguments if argument is not type(None)]
        if value is None and len(options) < len(arguments):
            return value
        if len(options) == 1:
            return _convert(options[0], value, where, metadata)
    if origin is typing.Literal and value not in arguments:
        raise ConfigError(f"{where} = {value!r:.80}: choose from {', '.join(map(str, arguments))}")
    if origin is tuple:
        if not isinstance(value, (list, tuple)):
            raise ConfigError(f"{where} = {value!r:.80}: expected a list")
        if arguments[1:] == (Ellipsis,):
            arguments = arguments[:1] * len(value)
        if len(value) != len(arguments):
            raise ConfigError(f"{where}: expected {len(arguments)} values, got {len(value)}")
        return tuple(_convert(a, item, where, metadata) for a, item in zip(arguments, value, strict=True))
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        value = float(value)
    if hint in (bool, int, float, str) and (not isinstance(value, hint) or (hint is int and isinstance(value, bool))):
        raise ConfigError(f"{where} = {value!r:.80}: expected {hint.__name__}")
    choices, low, high = metadata.get("choices"), metadata.get("low", -math.inf), metadata.get("high", math.inf)
    unit = f" {metadata['unit']}" if metadata.get("unit", "1") not in ("", "1") else ""
    if choices is not None and value not in choices:
        raise ConfigError(f"{where} = {value!r:.80}: choose from {', '.join(map(str, choices))}")
    if isinstance(value, float) and not math.isfinite(value):
        raise ConfigError(f"{where} = {value}: must be a finite number")
    if isinstance(value, (int, float)) and not isinstance(value, bool) and not low <= value <= high:
        raise ConfigError(f"{where} = {value:.10g}{unit}: must be between {low:.10g} and {high:.10g}{unit}")
    return value
