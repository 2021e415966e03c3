"""The command `dexsim`: every module's command under its word, options named in errors as they are typed, help without
a device, Ctrl-C at any time."""

import importlib

import pytest

from dexsim import __main__ as console, registry
from dexsim.core import cli
from dexsim.errors import ConfigError
from dexsim.tasks.grasp.config import GraspConfig
from dexsim_ppo.train import TrainArguments, preset_arguments


def test_a_word_runs_the_module_with_the_rest_of_the_line(monkeypatch):
    for name, (path, _) in console.COMMANDS.items():
        given = []
        monkeypatch.setattr(importlib.import_module(path), "main", lambda argv, given=given: given.append(argv) or 7)
        assert console.main([name, "--seed", "1"]) == 7 and given == [["--seed", "1"]]


def test_help_lists_the_commands_and_a_typo_is_named(capsys):
    assert console.main([]) == 0
    shown = capsys.readouterr().out
    assert all(f"  {name} " in shown for name in console.COMMANDS) and max(map(len, shown.splitlines())) <= 80
    with pytest.raises(ConfigError, match=r"^evalute: no such command \(perhaps evaluate\)"):
        console.main(["evalute"])


def test_a_misspelt_option_is_refused_and_the_right_one_named(capsys):
    default = preset_arguments("grasp", GraspConfig(), "cpu")
    with pytest.raises(SystemExit) as stop:
        cli.parse(
            TrainArguments[GraspConfig], ["--env.push-probabilty", "1"], prog="x", description="", default=default
        )
    assert stop.value.code == 2 and "--env.push-probability" in capsys.readouterr().err


def test_the_catalog_lists_what_there_is(capsys):
    assert registry.main([]) == 0
    shown = capsys.readouterr().out
    assert all(name in shown for name in ("rotate_clear", "xhand_right (default)", "leap_like", "grasp"))
