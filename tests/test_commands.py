"""Options of the commands: named in errors as they are typed; help without a device; what the catalogue lists."""

import os
import pkgutil
import subprocess
import sys

import pytest
from option_classes import OPTIONS

from dexsim.core import cli
from dexsim.core.errors import ConfigError
from dexsim.registry import TASKS
from dexsim_ppo.train import TrainArguments, preset_arguments


def load(command, task):
    """The options class and its defaults, or None."""
    if task:
        default = preset_arguments(task, TASKS[task].config(), "cpu")
        return TrainArguments[type(default.env)], default
    return pkgutil.resolve_name(OPTIONS[command][0]), None


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
