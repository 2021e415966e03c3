"""Every option of every command: documented, shown by --help with unit, range and choices, refused by its name."""

import dataclasses
import functools
import importlib
import os
import re
import subprocess
import sys
import types
import typing

import pytest
import tyro
from hypothesis import given, settings
from hypothesis import strategies as st

from dexsim.core import cli
from dexsim.core.options import field_docs
from dexsim.registry import TASKS
from dexsim_ppo.train import preset_arguments

# Options class or a maker of default options, and what must be typed beside the option that is looked at.
COMMANDS = {
    "dexsim_ppo.train": ("dexsim_ppo.train:TrainArguments", []),
    "dexsim_ppo.evaluate": ("dexsim_ppo.evaluate:EvaluateArguments", ["grasp"]),
    "dexsim_ppo.average": ("dexsim_ppo.average:AverageArguments", ["rotate", "rotate", "--output", "x.msgpack"]),
    "dexsim_ppo.export": ("dexsim_ppo.export:ExportArguments", ["grasp", "--output", "grasp.npz"]),
    "dexsim_ppo.record": ("dexsim_ppo.record:RecordArguments", ["grasp", "--rrd", "x.rrd"]),
    "dexsim_ppo.reproduce": ("dexsim_ppo.reproduce:ReproduceArguments", ["x.msgpack"]),
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
    def choices(self):
        """From its metadata, or its Literal type."""
        literals = [leaf for leaf in leaves(self.hint, literal=True) if isinstance(leaf, str)]
        return tuple(self.field.metadata.get("choices") or literals)

    @property
    def numeric(self):
        return bool(self.types & {int, float})


def leaves(hint, literal=False):
    if typing.get_origin(hint) is typing.Literal:
        yield from typing.get_args(hint) if literal else {type(value) for value in typing.get_args(hint)}
    elif typing.get_args(hint):
        for argument in typing.get_args(hint):
            yield from leaves(argument, literal)
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


def shown(capsys, command, *argv):
    """What a command prints for its help."""
    package = command if command.startswith("dexsim_ppo.") else f"{command}.__main__"
    with pytest.raises(SystemExit) as stop:
        importlib.import_module(package).main(list(argv))
    assert stop.value.code == 0
    text = capsys.readouterr().out
    assert max(map(len, text.splitlines())) <= 80
    return text


def entries(text):
    """The options of a help page: by name what stands in brackets, and the help text."""
    found = {}
    for block in re.split(r"\n(?= {0,2}\S)", text):
        match = re.match(r"  ([\w.-]+)(?:,? [^\[*]*)\[([^\[]*)\] ?(.*)", block.replace("\n", " ").replace("      ", ""))
        if match:
            found[match[1]] = match[2], match[3].strip()
    return found


def number(value):
    """A number as help pages print it."""
    return f"{value:.0f}" if value == int(value) and abs(value) < 1e10 else f"{value:.7g}"


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


# --- help -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("command", "task"), CASES)
def test_the_whole_help_shows_unit_range_choices_and_default(command, task, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    given = COMMANDS[command][1] if command == "dexsim_ppo.evaluate" else []
    page = entries(shown(capsys, command, "--help-all", *given, *(["--task", task] if task else [])))
    for found in options(command, task):
        facts, words = page.pop(found.name)
        assert words == field_docs(found.owner)[found.field.name]
        meta = found.field.metadata
        if meta.get("unit") not in (None, "", "1"):
            assert f"unit: {meta['unit']};" in facts
        for end in ("low", "high"):
            if meta.get(end) is not None:
                assert re.search(rf"range: [^;]*(?<![\d.]){re.escape(number(meta[end]))}(?![\d.])", facts), facts
        if found.choices:
            assert f"choices: {', '.join(found.choices)};" in facts
        if found.default is dataclasses.MISSING:
            assert facts == "required"
        elif isinstance(found.default, (int, float)) and not isinstance(found.default, bool):
            assert facts.endswith(f"default: {number(found.default)}")
        elif isinstance(found.default, str) and found.default:
            assert facts.endswith(f"default: {found.default}")
        else:
            assert "default: " in facts
    assert not page


@pytest.mark.parametrize(("command", "task"), CASES)
def test_the_short_help_has_all_of_the_command_and_nothing_of_its_groups(command, task, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    task_option = ["--task", task] if task else []
    text = shown(capsys, command, "--help", *task_option)
    names = [found.name for found in options(command, task)]
    assert set(entries(text)) - {"--help-all"} == {name for name in names if "." not in name}
    groups = {name[2:].partition(".")[0] for name in names if "." in name}
    for group in groups:
        inside = {name for name in names if name.startswith(f"--{group}.")}
        assert re.search(rf"\n  --{group}\.\*  [^\[]+\[{len(inside)}\s+options\]", text)
        assert set(entries(shown(capsys, command, "--help-all", group, *task_option))) == inside
    assert ("--help-all" in text) == bool(groups)


def test_help_starts_no_device():
    """With a platform that does not exist every start of JAX's devices fails."""
    environment = os.environ | {"JAX_PLATFORMS": "none_such", "COLUMNS": "80"}
    for command in ("dexsim_ppo.train", "dexsim_ppo.evaluate", "dexsim.randomization_check"):
        child = subprocess.run(
            [sys.executable, "-m", command, "--help"], env=environment, capture_output=True, text=True, check=False
        )
        assert child.returncode == 0 and child.stdout.startswith("usage: "), child.stderr


# --- errors ---------------------------------------------------------------------------------------------


def refusal(command, task, argv):
    cls, default, _ = load(command, task)
    if default is not None:
        cls = cls[type(default.env)]
    with pytest.raises(cli.UsageError) as caught:
        cli.parse(cls, [*COMMANDS[command][1], *argv], prog=command, description="", default=default)
    text = str(caught.value)
    assert "\n" not in text
    return text


def width(found):
    """How many values it takes."""
    arguments = typing.get_args(found.hint)
    return len(arguments) if typing.get_origin(found.hint) is tuple and Ellipsis not in arguments else 1


@pytest.mark.parametrize(("command", "task"), CASES)
@settings(max_examples=12, deadline=None)
@given(data=st.data())
def test_a_bad_value_is_refused_by_the_options_name(command, task, data):
    candidates = [f for f in options(command, task) if f.numeric or f.choices]
    if not candidates:
        return
    found = data.draw(st.sampled_from(candidates), label="option")
    low, high = found.field.metadata.get("low"), found.field.metadata.get("high")
    count = 2 if typing.get_origin(found.hint) is types.UnionType and "tuple" in str(found.hint) else width(found)
    outside = [*(() if low is None else (low - 1,)), *(() if high is None else (2 * high + 1,))]
    if found.choices:
        bad = data.draw(st.sampled_from(["nonsense", "12", "Auto"]), label="value")
    elif found.types & {float}:
        bad = str(data.draw(st.sampled_from([*outside, "nan", "inf", "many"]), label="value"))
    else:
        bad = str(data.draw(st.sampled_from([*outside, "1.5", "many"]), label="value"))
    text = refusal(command, task, [found.name, *[bad] * count])
    assert text.startswith(f"{found.name} "), text
    assert found.owner.__name__ not in text
    if found.choices:
        assert ", ".join(found.choices) in text
    elif re.fullmatch(r"-?[\d.]+", bad) and "expected" not in text:
        assert all(number(end) in text for end in (low, high) if end is not None)


@pytest.mark.parametrize(("command", "task"), CASES)
@settings(max_examples=8, deadline=None)
@given(data=st.data())
def test_a_misspelt_option_is_refused_and_the_right_one_named(command, task, data):
    long = [found for found in options(command, task) if found.name.startswith("--") and len(found.name) > 5]
    found = data.draw(st.sampled_from(long))
    at = data.draw(st.integers(4, len(found.name) - 1))
    wrong = found.name[:at] + "qq" + found.name[at:]
    text = refusal(command, task, [wrong, "1"])
    assert re.match(rf"{re.escape(wrong)}: no such option \(perhaps --[\w.-]+\); see --help$", text)


def test_reversed_ranges_are_refused_by_the_options_name():
    command, task = "dexsim_ppo.train", "grasp"
    seen = 0
    for found in options(command, task):
        value, meta = found.default, found.field.metadata
        if found.hint != tuple[float, float] or value[0] >= value[1] or meta.get("low") is None:
            continue
        try:
            dataclasses.replace(found.owner(), **{found.field.name: value[::-1]})
        except cli.ConfigError:
            text = refusal(command, task, [found.name, *map(str, value[::-1])])
            assert text == f"{found.name} {number(value[1])} {number(value[0])}: the first must not exceed the second"
            seen += 1
    assert seen > 20


@pytest.mark.parametrize("count", [0, -1])
def test_no_environments_are_refused_everywhere(count):
    import dexsim

    for command, task, name in (
        ("dexsim_ppo.train", "grasp", "--ppo.num-envs"),
        ("dexsim_ppo.train", "grasp", "--evaluation-chunk"),
        ("dexsim.randomization_check", "", "--num-envs"),
    ):
        assert refusal(command, task, [name, str(count)]).startswith(f"{name} {count}")
    if count < 0:
        assert refusal("dexsim_ppo.evaluate", "", ["--chunk", str(count)]).startswith(f"--chunk {count}")
    with pytest.raises(cli.ConfigError, match=f"{count}.*must be at least 1"):
        dexsim.make("grasp", num_envs=count)


def test_classes_of_one_command_have_names_of_their_own():
    """Messages are translated by class name, so that none may stand for two groups."""
    for command, task in CASES:
        owners = [(found.name.rpartition(".")[0], found.owner) for found in options(command, task)]
        names = [owner.__name__ for _, owner in dict.fromkeys(owners)]
        assert len(names) == len(set(names)), command
