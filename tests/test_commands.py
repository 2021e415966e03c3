"""Every option of every command: documented, and named in errors as it is typed."""

import ast
import dataclasses
import functools
import inspect
import itertools
import os
import pkgutil
import subprocess
import sys
import textwrap
import typing

import pytest
from option_classes import OPTIONS

from dexsim.core import cli
from dexsim.core.errors import ConfigError
from dexsim.registry import TASKS
from dexsim_ppo.train import TrainArguments, preset_arguments

CASES = [(command, "") for command in OPTIONS if command != "dexsim_ppo.train"]
CASES += [("dexsim_ppo.train", task) for task in ("grasp", "rotate")]


def load(command, task):
    """The options class and its defaults, or None."""
    if task:
        default = preset_arguments(task, TASKS[task].config(), "cpu")
        return TrainArguments[type(default.env)], default
    return pkgutil.resolve_name(OPTIONS[command][0]), None


def owners(cls, default):
    """The options class and those of its fields that are groups of options."""
    yield cls
    for field in dataclasses.fields(cls):
        value = getattr(default, field.name) if default is not None else field.default
        if value is dataclasses.MISSING and field.default_factory is not dataclasses.MISSING:
            value = field.default_factory()
        if dataclasses.is_dataclass(value):
            yield from owners(type(value), value)


def leaves(hint):
    """The plain types in an annotation: float and NoneType of `tuple[float, float] | None`."""
    if typing.get_origin(hint) is typing.Literal:
        return {type(value) for value in typing.get_args(hint)}
    arguments = typing.get_args(hint)
    return set().union(*map(leaves, arguments)) if arguments else {hint}


@functools.cache
def field_docs(cls):
    """The docstring under each field of a dataclass, on one line."""
    docs = {}
    for base in reversed([c for c in cls.__mro__ if dataclasses.is_dataclass(c)]):
        body = ast.parse(textwrap.dedent(inspect.getsource(base))).body[0].body
        for field, after in itertools.pairwise(body):
            if isinstance(field, ast.AnnAssign) and isinstance(after, ast.Expr):
                docs[ast.unparse(field.target)] = " ".join(ast.literal_eval(after.value).split())
    return docs


@pytest.mark.parametrize(("command", "task"), CASES)
def test_every_option_says_what_it_is(command, task):
    """A help text that stands alone; of a number its unit ("1": none) and range; what None means."""
    lacking = []
    cls, default = load(command, task)
    for owner in owners(typing.get_origin(cls) or cls, default):
        hints = typing.get_type_hints(owner)
        for field in dataclasses.fields(owner):
            text, kinds = field_docs(owner).get(field.name, ""), leaves(hints[field.name])
            limits = [field.metadata.get(end) for end in ("low", "high")]
            for lacks, what in (
                (len(text) < 6 or not text.endswith("."), "help text that ends with a full stop"),
                (kinds & {int, float} and not field.metadata.get("unit"), "unit"),
                (kinds & {int, float} and limits == [None, None], "range"),
                (type(None) in kinds and "None" not in text, "what None means"),
            ):
                if lacks:
                    lacking.append(f"{owner.__name__}.{field.name}: {what}")
    assert lacking == []


def test_help_starts_no_device():
    """With a platform that does not exist every start of JAX's devices fails."""
    environment = os.environ | {"JAX_PLATFORMS": "none_such", "COLUMNS": "80"}
    command = [sys.executable, "-m", "dexsim_ppo.train", "--help"]
    child = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert child.returncode == 0 and child.stdout.startswith("usage: "), child.stderr


@pytest.mark.parametrize(
    ("command", "option", "says"),
    [
        ("dexsim_ppo.train", ["--env.push-probability", "3"], "GraspConfig.push_probability = 3: must be between"),
        ("dexsim_ppo.train", ["--env.curl", "0.2", "-0.2"], "GraspConfig.curl = (0.2, -0.2): the first must not"),
        ("dexsim_ppo.evaluate", ["--chunk", "-1"], "EvaluateArguments.chunk = -1: "),
    ],
)
def test_a_value_out_of_range_is_refused_by_the_fields_name(command, option, says):
    cls, default = load(command, "grasp" if command == "dexsim_ppo.train" else "")
    with pytest.raises(ConfigError) as error:
        cli.parse(cls, [*OPTIONS[command][1], *option], prog=command, description="", default=default)
    assert str(error.value).startswith(says) and "\n" not in str(error.value)


def test_a_misspelt_option_is_refused_and_the_right_one_named(capsys):
    cls, default = load("dexsim_ppo.train", "grasp")
    with pytest.raises(SystemExit) as stop:
        cli.parse(cls, ["--env.push-probabilty", "1"], prog="x", description="", default=default)
    assert stop.value.code == 2 and "--env.push-probability" in capsys.readouterr().err


def test_the_catalog_lists_what_there_is(capsys):
    from dexsim.catalog import main

    assert main([]) == 0
    shown = capsys.readouterr().out
    assert all(name in shown for name in ("rotate_clear", "xhand_right (default)", "leap_like", "grasp"))
