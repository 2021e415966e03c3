"""The options of a command, read from its dataclass: name, help text, unit, range, choices and default of each.

The help pages and the option names in error messages come from here; tyro parses the values.
"""

import ast
import dataclasses
import difflib
import functools
import inspect
import itertools
import re
import shutil
import textwrap
import types
import typing
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from dexsim.core.config import choices_of, number_text, range_text

METAVARS = {bool: "True|False", int: "INT", float: "FLOAT", str: "TEXT", Path: "PATH"}
KINDS = {bool: "True or False", int: "a whole number", float: "a number", str: "a word", Path: "a path"}
MANY = {bool: "values, each True or False", int: "whole numbers", float: "numbers", str: "words", Path: "paths"}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Option:
    """One option of a command: a field of its dataclass or of one nested in it."""

    owner: type
    """Dataclass that the field belongs to."""
    path: tuple[str, ...]
    """Names of the fields that lead to it."""
    hint: Any
    """The field's type, without `Annotated`."""
    default: Any
    """Value without the option; `dataclasses.MISSING` where it must be given."""
    metadata: typing.Mapping[str, Any]
    """What `setting` said of the field."""
    positional: bool
    """Whether it is given by its place instead of its name."""

    @property
    def name(self) -> str:
        """As it is typed: --env.push-probability, or POLICY if its place says what it is."""
        name = ".".join(self.path).replace("_", "-")
        return name.upper() if self.positional else f"--{name}"

    @property
    def required(self) -> bool:
        """Whether it must be given."""
        return self.default is dataclasses.MISSING

    @property
    def text(self) -> str:
        """The docstring under the field, on one line."""
        return field_docs(self.owner).get(self.path[-1], "")

    @property
    def unit(self) -> str:
        """Unit of the value; empty for a pure number."""
        unit = self.metadata.get("unit") or ""
        return "" if unit == "1" else unit

    @property
    def range(self) -> str:
        """Such as "0 to 5" or "at least 1"; empty without a limit."""
        return range_text(self.metadata.get("low"), self.metadata.get("high"), "{} to {}")

    @property
    def choices(self) -> tuple[Any, ...]:
        """What may be given; empty if any value may."""
        return choices_of(self.owner).get(self.path[-1], ())

    @functools.cached_property
    def values(self) -> tuple[tuple[Any, ...], bool]:
        """Types of the values that follow the name, and whether the last one may repeat."""
        hint = self.hint
        if typing.get_origin(hint) in (typing.Union, types.UnionType):
            hint = next(a for a in typing.get_args(hint) if a is not type(None))
        arguments = typing.get_args(hint)
        if typing.get_origin(hint) is tuple:
            many = arguments[-1] is Ellipsis
            return tuple(_scalar(a) for a in (arguments[:1] if many else arguments)), many
        return ((), False) if hint is bool else ((_scalar(hint),), False)

    @property
    def usage(self) -> str:
        """The name and what follows it: --env.finger-force FLOAT FLOAT."""
        kinds, many = self.values
        if not kinds:
            return f"{self.name}, {self.negation}"
        if self.positional:
            return self.name
        words = ["NAME" if self.choices and kind is str else METAVARS.get(kind, "VALUE") for kind in kinds]
        return " ".join([self.name, *words, *(["..."] if many else [])])

    @property
    def negation(self) -> str:
        """What switches it off: --env.no-touch."""
        *groups, last = self.name.removeprefix("--").split(".")
        return "--" + ".".join([*groups, f"no-{last}"])

    @property
    def expected(self) -> str:
        """What must follow the name, in words."""
        kinds, many = self.values
        if self.choices:
            return f"choose from {', '.join(map(str, self.choices))}"
        if not kinds:
            return f"takes no value; {self.negation} switches it off"
        if many:
            return f"expected {MANY.get(kinds[0], 'values')}"
        if len(kinds) > 1:
            return f"expected {len(kinds)} {MANY.get(kinds[0], 'values')}"
        return f"expected {KINDS.get(kinds[0], 'a value')}"

    @property
    def facts(self) -> str:
        """Unit, range, choices and default, in brackets."""
        facts = {"unit": self.unit, "range": self.range, "choices": ", ".join(map(str, self.choices))}
        shown = [f"{name}: {fact}" for name, fact in facts.items() if fact]
        if self.required:
            shown.append("required")
        elif self.hint is bool:
            shown.append(f"default: {'on' if self.default else 'off'}")
        else:
            shown.append(f"default: {value_text(self.default)}")
        return f"[{'; '.join(shown)}]"


def _scalar(hint: Any) -> Any:
    """Type of a single value, for names and messages."""
    return type(typing.get_args(hint)[0]) if typing.get_origin(hint) is typing.Literal else hint


def value_text(value: Any) -> str:
    """A value as it is typed."""
    if isinstance(value, tuple):
        return " ".join(map(value_text, value)) or "empty"
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        return number_text(value)
    return str(value) or "empty"


@functools.cache
def field_docs(cls: type) -> dict[str, str]:
    """The docstring under each field of a dataclass, each on one line."""
    docs: dict[str, str] = {}
    for base in reversed([c for c in cls.__mro__ if dataclasses.is_dataclass(c)]):
        definition = ast.parse(textwrap.dedent(inspect.getsource(base))).body[0]
        assert isinstance(definition, ast.ClassDef)
        for field, after in itertools.pairwise(definition.body):
            if isinstance(field, ast.AnnAssign) and isinstance(after, ast.Expr):
                docs[ast.unparse(field.target)] = " ".join(ast.literal_eval(after.value).split())
    return docs


def options_of(cls: type, default: Any = None, path: tuple[str, ...] = ()) -> list[Option]:
    """Every option of a dataclass, nested ones behind those of their group.

    Args:
      cls: the dataclass, which may be generic.
      default: an instance whose values are the defaults; those of the class when None.
    """
    from tyro.conf import Positional

    cls = typing.get_origin(cls) or cls
    hints = typing.get_type_hints(cls, include_extras=True)
    options, nested = [], []
    for field in dataclasses.fields(cls):
        value, hint = _default(field, default), hints[field.name]
        marks: list[Any] = []
        here = (*path, field.name)
        if dataclasses.is_dataclass(value):
            nested += options_of(type(value), value, here)
            continue
        if typing.get_origin(hint) is typing.Annotated:
            hint, *marks = typing.get_args(hint)
        options.append(
            Option(
                owner=cls,
                path=here,
                hint=hint,
                default=value,
                metadata=field.metadata,
                positional=Positional in marks,
            )
        )
    return [*sorted(options, key=lambda option: not option.positional), *nested]


def _default(field: dataclasses.Field, instance: Any) -> Any:
    if instance is not None:
        return getattr(instance, field.name)
    return field.default if field.default_factory is dataclasses.MISSING else field.default_factory()


def group_docs(cls: type, default: Any = None, path: tuple[str, ...] = ()) -> dict[tuple[str, ...], str]:
    """Help text of each group of options, by the path of its field."""
    cls = typing.get_origin(cls) or cls
    groups = {}
    for field in dataclasses.fields(cls):
        value, here = _default(field, default), (*path, field.name)
        if dataclasses.is_dataclass(value):
            groups[here] = field_docs(cls).get(field.name, "")
            groups |= group_docs(type(value), value, here)
    return groups


# --- help ---------------------------------------------------------------------------------------------


def help_page(cls: type, default: Any, *, prog: str, description: str, group: str | None = "") -> str:
    """The help of a command, for the terminal's width.

    Args:
      cls: dataclass of the command's options.
      default: an instance whose values are the defaults; those of the class when None.
      prog: the command as it is typed.
      description: what it does.
      group: "" for the command's own options with one line for each group; the name of a group, such as
        "env.physics", for that group; None for everything.
    """
    options, groups = options_of(cls, default), group_docs(cls, default)
    places = [option.name for option in options if option.positional]
    lines = [f"usage: {' '.join([prog, *places, '[options]'])}", "", *_filled(description, "")]
    own = tuple(group.split(".")) if group else ()
    for path in [own] if group == "" else [path for path in ((), *groups) if path[: len(own)] == own]:
        title = f"--{'.'.join(path).replace('_', '-')}: {groups[path]}" if path else "options:"
        lines += ["", *_filled(title, "")]
        for option in options:
            if option.path[:-1] == path:
                lines += _filled(f"{option.usage}  {option.facts}", "  ", "      ")
                lines += _filled(option.text, "      ")
    if group == "" and groups:
        lines += ["", "groups of options:"]
        for path in (path for path in groups if len(path) == 1):
            inside = sum(option.path[:1] == path for option in options)
            lines += _filled(f"--{path[0].replace('_', '-')}.*  {groups[path]} [{inside} options]", "  ", "      ")
    lines += ["", *_filled(_more(group, groups), "")]
    return "\n".join(lines)


def _more(group: str | None, groups: Iterable[tuple[str, ...]]) -> str:
    first = next(iter(groups), None)
    if first is None:
        return "-h, --help shows this page."
    if group is None:
        return "-h, --help shows a short page."
    return f"--help-all shows every option; --help-all GROUP those of one group, such as --help-all {first[0]}."


def _filled(text: str, indent: str, after: str | None = None) -> list[str]:
    """A paragraph as lines of the terminal's width, at most 100 columns."""
    return textwrap.wrap(
        text,
        min(shutil.get_terminal_size().columns, 100),
        initial_indent=indent,
        subsequent_indent=indent if after is None else after,
        break_long_words=False,
        break_on_hyphens=False,
    )


# --- errors -------------------------------------------------------------------------------------------


def given(argv: Sequence[str]) -> dict[str, list[str]]:
    """What was typed: the values after each name, and under "" those before the first name."""
    found: dict[str, list[str]] = {"": []}
    last = ""
    for token in argv:
        if token.startswith("--"):
            last, _, value = token.partition("=")
            last = last.replace("_", "-")
            found.setdefault(last, [])
            token = value
        if token:
            found[last].append(token)
    return found


def in_option_names(message: str, options: Iterable[Option], typed: Callable[[Option], str | None]) -> str:
    """An error message that names fields by class, with what is typed instead.

    Args:
      message: such as "GraspConfig.push_probability = 1.5: must be between 0 and 1".
      options: those that may be meant.
      typed: what is typed before an option's value, such as "--env.push-probability "; None for an option that
        was not typed.
    """
    for option in options:
        before = typed(option)
        if before is None:
            continue
        field = rf"\b{re.escape(option.owner.__name__)}\.{option.path[-1]}"
        message = re.sub(rf"{field} = '([^']*)'", functools.partial(_unwrapped, before), message)
        message = re.sub(rf"{field} = \(([^()]*)\)", functools.partial(_unwrapped, before, drop=","), message)
        message = re.sub(rf"{field} = ", before, message)
        message = re.sub(rf"{field}\b", before.rstrip(" ="), message)
    return message


def explain(argv: Sequence[str], options: Sequence[Option], message: str) -> str:
    """What is wrong with a command line that does not parse, on one line.

    Args:
      argv: the command line.
      options: the command's options.
      message: what the parser said of it.
    """
    by_name = {name: option for option in options for name in (option.name, option.negation)}
    typed = given(argv)
    for name in typed:
        if name and name not in by_name:
            return f"{name}: no such option{_meant(name, by_name)}"
    for name in re.findall(r"--[\w.-]+", message):
        if (name := name.rstrip(".")) in typed and name in by_name:
            return f"{' '.join([name, *typed[name]])}: {by_name[name].expected}"
    if message.startswith("Missing"):
        # A place has no name in the message, but its help text.
        missing = [o.name for o in options if o.required and (o.name in message or o.text[:30] in message)]
        return f"{' and '.join(missing)} must be given"
    stray = re.search(r"Unrecognized \w+: (.*)", message)
    for name, values in typed.items():
        if stray and stray[1].split(", ")[0] in values:
            if name:
                return f"{' '.join([name, *values])}: {by_name[name].expected}"
            return f"{stray[1]}: not an option"
    return message


def _meant(name: str, names: Iterable[str]) -> str:
    """The option that was perhaps meant: the same name in a group, or one spelled much like it."""
    names = [candidate for candidate in names if candidate.startswith("--")]
    same = [n for n in names if n.rpartition(".")[2] == name.removeprefix("--")]
    return f" (perhaps {same[0]})" if same else closest(name, names)


def closest(name: str, names: Iterable[str]) -> str:
    """The name that was perhaps meant, as the end of a message; empty if none is spelled like it."""
    return "".join(f" (perhaps {near})" for near in difflib.get_close_matches(name, names, n=1))


def _unwrapped(before: str, match: re.Match[str], drop: str = "") -> str:
    """`before` and the value inside quotes or parentheses, without `drop`."""
    return before + (match[1].replace(drop, "") if drop else match[1])
