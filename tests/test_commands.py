"""Every option of every command: documented, and named in errors as it is typed."""

import ast
import dataclasses
import functools
import importlib
import inspect
import itertools
import os
import re
import subprocess
import sys
import textwrap
import types
import typing

import pytest
import tyro

from dexsim.core import cli
from dexsim.core.errors import ConfigError
from dexsim.registry import TASKS
from dexsim_ppo.train import preset_arguments

# Options class or a maker of default options, and what must be typed beside the option that is looked at.
COMMANDS = {
    "dexsim_ppo.train": ("dexsim_ppo.train:TrainArguments", []),
    "dexsim_ppo.evaluate": ("dexsim_ppo.evaluate:EvaluateArguments", ["grasp"]),
    "dexsim_ppo.average": ("dexsim_ppo.average:AverageArguments", ["rotate", "rotate", "--output", "x.msgpack"]),
    "dexsim_ppo.export": ("dexsim_ppo.export:ExportArguments", ["grasp", "--output", "grasp.onnx"]),
    "dexsim_ppo.record": ("dexsim_ppo.record:RecordArguments", ["grasp", "--rrd", "x.rrd"]),
    "dexsim_real.run": ("dexsim_real.run.options:RunArguments", ["grasp", "--port", "x", "--uncalibrated"]),
    "dexsim_real.calibrate": ("dexsim_real.calibrate.options:CalibrateArguments", ["--port", "x"]),
    "dexsim_real.twin": ("dexsim_real.twin.options:TwinArguments", []),
    "dexsim_real.replay": ("dexsim_real.replay.__main__:ReplayArguments", ["x.log"]),
    "dexsim.view": ("dexsim.view.__main__:ViewArguments", ["grasp"]),
    "dexsim.randomization_check": ("dexsim.randomization_check.__main__:CheckArguments", []),
}
CASES = [(command, "") for command in COMMANDS if command != "dexsim_ppo.train"]
CASES += [("dexsim_ppo.train", task) for task in ("grasp", "rotate")]


class Found(typing.NamedTuple):
    """A field of an options class, found without the code that is tested."""

    name: str
    owner: type
    field: dataclasses.Field
    hint: typing.Any
    default: typing.Any

    @property
    def types(self):
        """The plain types in its annotation: float and NoneType of `tuple[float, float] | None`."""
        return set(leaves(self.hint))

    @property
    def numeric(self):
        return bool(self.types & {int, float})


def leaves(hint):
    if typing.get_origin(hint) is typing.Literal:
        yield from {type(value) for value in typing.get_args(hint)}
    elif typing.get_args(hint):
        for argument in typing.get_args(hint):
            yield from leaves(argument)
    else:
        yield hint


def walk(cls, default, path=()):
    hints, marked = typing.get_type_hints(cls), typing.get_type_hints(cls, include_extras=True)
    for field in dataclasses.fields(cls):
        value = getattr(default, field.name) if default is not None else field.default
        if default is None and field.default_factory is not dataclasses.MISSING:
            value = field.default_factory()
        here = (*path, field.name)
        if dataclasses.is_dataclass(value):
            yield Found(".".join(here), cls, field, None, value)
            yield from walk(type(value), value, here)
        else:
            name = ".".join(here).replace("_", "-")
            place = tyro.conf.Positional in getattr(marked[field.name], "__metadata__", ())
            yield Found(name.upper() if place else f"--{name}", cls, field, hints[field.name], value)


@functools.cache
def load(command, task):
    """The options class, its defaults or None, and all fields."""
    module, _, name = COMMANDS[command][0].partition(":")
    cls = getattr(importlib.import_module(module), name)
    default = preset_arguments(task, TASKS[task].config(), "cpu") if task else None
    return cls, default, tuple(walk(cls, default))


def options(command, task):
    return [found for found in load(command, task)[2] if found.hint is not None]


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


# --- documentation --------------------------------------------------------------------------------------


@pytest.mark.parametrize(("command", "task"), CASES)
def test_every_option_says_what_it_is(command, task):
    """A help text that stands alone; of a number its unit ("1": none) and range; what None means."""
    lacking = []
    for found in load(command, task)[2]:
        text = field_docs(found.owner).get(found.field.name, "")
        place = f"{found.owner.__name__}.{found.field.name}"
        if len(text) < 6 or not text.endswith("."):
            lacking.append(f"{place}: help text, a sentence or a noun phrase that ends with a full stop")
        if not (text[:1].isupper() or re.match(r"[\w]+: ", text)) and text[:1] not in '+"':
            lacking.append(f"{place}: help text of its own, not the rest of another's: {text!r}")
        if found.hint is None:
            continue
        if found.numeric and not found.field.metadata.get("unit"):
            lacking.append(f"{place}: unit")
        if found.numeric and found.field.metadata.get("low") is None and found.field.metadata.get("high") is None:
            lacking.append(f"{place}: range")
        if types.NoneType in found.types and not re.search(r"\bNone\b", text):
            lacking.append(f"{place}: what None means")
    assert lacking == []


def test_help_starts_no_device():
    """With a platform that does not exist every start of JAX's devices fails."""
    environment = os.environ | {"JAX_PLATFORMS": "none_such", "COLUMNS": "80"}
    command = [sys.executable, "-m", "dexsim_ppo.train", "--help"]
    child = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert child.returncode == 0 and child.stdout.startswith("usage: "), child.stderr


# --- errors ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("command", "option", "says"),
    [
        (
            "dexsim_ppo.train",
            ["--env.push-probability", "3"],
            "GraspConfig.push_probability = 3: must be between",
        ),
        (
            "dexsim_ppo.train",
            ["--env.curl", "0.2", "-0.2"],
            "GraspConfig.curl = (0.2, -0.2): the first must not",
        ),
        ("dexsim_ppo.evaluate", ["--chunk", "-1"], "EvaluateArguments.chunk = -1: "),
    ],
)
def test_a_value_out_of_range_is_refused_by_the_fields_name(command, option, says):
    cls, default, _ = load(command, "grasp" if command == "dexsim_ppo.train" else "")
    if default is not None:
        cls = cls[type(default.env)]
    with pytest.raises(ConfigError) as error:
        cli.parse(cls, [*COMMANDS[command][1], *option], prog=command, description="", default=default)
    assert str(error.value).startswith(says) and "\n" not in str(error.value)


def test_a_misspelt_option_is_refused_and_the_right_one_named(capsys):
    cls, default, _ = load("dexsim_ppo.train", "grasp")
    with pytest.raises(SystemExit) as stop:
        cli.parse(cls[type(default.env)], ["--env.push-probabilty", "1"], prog="x", description="", default=default)
    assert stop.value.code == 2 and "--env.push-probability" in capsys.readouterr().err


def test_the_catalog_lists_what_there_is(capsys):
    from dexsim.catalog import main

    assert main([]) == 0
    shown = capsys.readouterr().out
    assert all(name in shown for name in ("rotate_clear", "xhand_right (default)", "leap_like", "grasp"))
