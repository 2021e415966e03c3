"""Configuration: frozen dataclasses with a unit and a range on each number.

The same dataclasses are the command line (tyro), the checkpoint header and the documentation.
"""

import ast
import contextlib
import dataclasses
import functools
import json
import math
import types
import typing
from collections.abc import Collection, Iterable
from typing import TYPE_CHECKING, Any, TypeVar

from dexsim.core.errors import ConfigError

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

T = TypeVar("T", bound="DataclassInstance")


def setting(
    default: Any,
    *,
    unit: str = "",
    low: float | None = None,
    high: float | None = None,
    choices: Collection[str] | None = None,
) -> Any:
    """A configuration field with its unit and allowed range, checked by `validate`.

    Numbers inside a tuple are each held to the range.
    """
    metadata = {"unit": unit, "low": low, "high": high, "choices": choices}
    if dataclasses.is_dataclass(default) or isinstance(default, (list, dict)):
        return dataclasses.field(default_factory=lambda: default, metadata=metadata)
    return dataclasses.field(default=default, metadata=metadata)


def validate(config: Any) -> None:
    """Check every field of a config dataclass against its type and metadata; call from `__post_init__`.

    Lists become tuples and NumPy's numbers Python's, as a file would give them back.

    Raises:
      ConfigError: names the class, the field, the value, and its type or the unit and the range.
    """
    cls: type = type(config)
    for field in dataclasses.fields(cls):
        where = f"{cls.__name__}.{field.name}"
        value = _checked(_hints(cls).get(field.name), getattr(config, field.name), where)
        if value is not getattr(config, field.name):
            object.__setattr__(config, field.name, value)
        choices = choices_of(cls).get(field.name)
        if choices is not None and value is not None:
            for item in value if isinstance(value, tuple) else (value,):
                if item not in choices:
                    raise ConfigError(f"{where} = {item!r:.80}: choose from {', '.join(map(str, choices))}")
        low, high = field.metadata.get("low"), field.metadata.get("high")
        for number in _numbers(value):
            if not math.isfinite(number):
                raise ConfigError(f"{where} = {number}: must be a finite number")
            if (low is not None and number < low) or (high is not None and number > high):
                unit = field.metadata.get("unit")
                unit = f" {unit}" if unit and unit != "1" else ""
                span = range_text(low, high, "between {} and {}")
                raise ConfigError(f"{where} = {number_text(number)}{unit}: must be {span}{unit}")


class Config:
    """Base of configuration dataclasses: every field is checked when one is made.

    A subclass with checks of its own extends `__post_init__` and calls this one first.
    """

    def __post_init__(self) -> None:
        validate(self)


@functools.cache
def choices_of(cls: type) -> dict[str, tuple[Any, ...]]:
    """What each field may be, where only some values may: by its `setting` or its `Literal` type."""
    fields, hints = dataclasses.fields(cls), _hints(cls)
    choices = {field.name: field.metadata.get("choices") or _literals(hints.get(field.name)) for field in fields}
    return {name: values for name, values in choices.items() if values}


@functools.cache
def _hints(cls: type) -> dict[str, Any]:
    """The types of a class's fields; none if one of them is only imported by type checkers."""
    try:
        return typing.get_type_hints(cls)
    except NameError:
        return {}


def _checked(hint: Any, value: Any, where: str) -> Any:
    """A field's value as `_rebuild` has it. A configuration in a field is one already, and integers are numbers too."""
    if isinstance(hint, type) and dataclasses.is_dataclass(hint):
        if not isinstance(value, hint):
            raise ConfigError(f"{where} = {value!r:.80}: expected a {hint.__name__}")
        return value
    if hint not in (bool, int, float, str) and typing.get_origin(hint) is not tuple:
        return value
    value = _plain(value)
    rebuilt = _rebuild(hint, value, where)
    return value if value == rebuilt else rebuilt


def _plain(value: Any) -> Any:
    """Python's numbers and lists for NumPy's, in a tuple too."""
    if isinstance(value, (tuple, list)):
        return type(value)(map(_plain, value))
    return value.tolist() if hasattr(value, "tolist") else value


def range_text(low: float | None, high: float | None, both: str) -> str:
    """A range in words; `both` is the pattern where it has two ends. Empty without a limit."""
    if low is not None and high is not None:
        return both.format(number_text(low), number_text(high))
    if low is not None:
        return f"at least {number_text(low)}"
    return f"at most {number_text(high)}" if high is not None else ""


def number_text(number: float) -> str:
    """A number as a person writes it: 100000 rather than 1e+05."""
    return f"{number:.0f}" if abs(number) < 1e10 and number == int(number) else f"{number:.7g}"


def _literals(hint: Any) -> tuple[Any, ...]:
    if typing.get_origin(hint) is typing.Literal:
        return typing.get_args(hint)
    return tuple(value for argument in typing.get_args(hint) for value in _literals(argument))


def check_ranges(config: Any, *names: str) -> None:
    """Require that each named `(low, high)` field is ordered."""
    for name in names:
        low, high = getattr(config, name)
        if low > high:
            raise ConfigError(
                f"{type(config).__name__}.{name} = ({number_text(low)}, {number_text(high)}): "
                "the first must not exceed the second"
            )


def _numbers(value: Any) -> list[float]:
    if isinstance(value, bool) or value is None or isinstance(value, str):
        return []
    if isinstance(value, (int, float)):
        try:
            return [float(value)]
        except OverflowError:  # A whole number of hundreds of digits.
            return [math.inf]
    if isinstance(value, tuple):
        return [number for item in value for number in _numbers(item)]
    return []


@dataclasses.dataclass(frozen=True)
class NoSettings:
    """The configuration of an environment that has none."""


def to_dict(config: Any) -> dict[str, Any]:
    """A config dataclass as nested plain dicts and lists (JSON and msgpack friendly)."""

    def plain(value: Any) -> Any:
        if dataclasses.is_dataclass(value):
            return {f.name: plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
        return [plain(item) for item in value] if isinstance(value, (tuple, list)) else value

    return plain(config)


def from_dict(cls: type[T], data: dict[str, Any]) -> T:
    """Rebuild a config dataclass from `to_dict`'s output; fields left out keep their default.

    Raises:
      ConfigError: an unknown field, or a value of the wrong type or out of range.
    """
    if not isinstance(data, dict):
        raise ConfigError(f"{cls.__name__}: expected a table of fields, got {type(data).__name__}")
    hints = typing.get_type_hints(cls)
    known = {field.name for field in dataclasses.fields(cls)}
    for name in data:
        if name not in known:
            raise ConfigError(f"{cls.__name__} has no field {name!r:.80}")
    return cls(**{name: _rebuild(hints[name], value, f"{cls.__name__}.{name}") for name, value in data.items()})


@contextlib.contextmanager
def naming_file(path: object) -> typing.Iterator[None]:
    """Errors from within begin with the name of the file that the configuration is read from."""
    try:
        yield
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None


def override(data: dict[str, Any], settings: Iterable[str]) -> dict[str, Any]:
    """`to_dict`'s output with some fields replaced, each as "object.extremes=1" or "edge=[0.05, 0.06]".

    Values are JSON, Python's literals (which have .006 and 5.), and words without quotes. `from_dict` tells whether the
    fields exist and the values fit.

    Raises:
      ConfigError: a setting without a name or a value.
    """
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


def _rebuild(hint: Any, value: Any, where: str) -> Any:
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if isinstance(hint, type) and dataclasses.is_dataclass(hint):
        return from_dict(hint, value)
    if origin in (typing.Union, types.UnionType):
        if value is None and type(None) in arguments:
            return None
        return _rebuild(next(a for a in arguments if a is not type(None)), value, where)
    if origin is tuple:
        if not isinstance(value, (list, tuple)):
            raise ConfigError(f"{where} = {value!r:.80}: expected a list")
        if len(arguments) == 2 and arguments[1] is Ellipsis:
            return tuple(_rebuild(arguments[0], item, where) for item in value)
        if len(value) != len(arguments):
            raise ConfigError(f"{where}: expected {len(arguments)} values, got {len(value)}")
        return tuple(_rebuild(a, item, where) for a, item in zip(arguments, value, strict=True))
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        return _numbers(value)[0]
    if isinstance(hint, type) and (not isinstance(value, hint) or (hint is int and isinstance(value, bool))):
        raise ConfigError(f"{where} = {value!r:.80}: expected {hint.__name__}")
    return value
