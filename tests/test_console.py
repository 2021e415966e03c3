"""The console command `dexsim`: every command under its word, and errors that name the page that helps."""

import importlib
import os
import subprocess
import sys

import pytest
from paths import ROOT

from dexsim import __main__ as console
from dexsim.core.errors import ConfigError


@pytest.mark.parametrize("name", console.COMMANDS)
def test_a_word_runs_the_module_with_the_rest_of_the_line(name, monkeypatch):
    module = importlib.import_module(console.COMMANDS[name][0])
    given = []
    monkeypatch.setattr(module, "main", lambda argv: given.append(argv) or 7)
    assert console.main([name, "--seed", "1"]) == 7 and given == [["--seed", "1"]]


def test_every_command_of_the_modules_has_a_word():
    modules = {module for module, _ in console.COMMANDS.values()}
    folders = [ROOT / package for package in ("dexsim", "dexsim_ppo", "dexsim_real")]
    found = {
        ".".join(path.relative_to(ROOT).with_suffix("").parts)
        for folder in folders
        for path in folder.rglob("*.py")
        if "cli.run(main)" in path.read_text()
    }
    assert found - {"dexsim.__main__"} == modules


def test_help_lists_the_commands_and_a_typo_is_named(capsys):
    assert console.main([]) == 0
    shown = capsys.readouterr().out
    assert all(f"  {name} " in shown for name in console.COMMANDS) and max(map(len, shown.splitlines())) <= 80
    with pytest.raises(ConfigError, match=r"^evalute: no such command \(perhaps evaluate\)"):
        console.main(["evalute"])


@pytest.mark.parametrize(
    "words",
    ["dexsim_real.run", "dexsim train"],
)
def test_ctrl_c_while_modules_load_is_one_line(words, tmp_path):
    """Sent while a module is looked for that each command imports late."""
    (tmp_path / "sitecustomize.py").write_text("""
import os, signal, sys

class Interrupt:
    def find_spec(self, name, path=None, target=None):
        if name == "numpy":
            os.kill(os.getpid(), signal.SIGINT)

sys.meta_path.insert(0, Interrupt())
""")
    env = os.environ | {"PYTHONPATH": os.pathsep.join([str(tmp_path), str(ROOT)])}
    command = [sys.executable, "-m", *words.split()]
    done = subprocess.run(command, cwd=ROOT, env=env, capture_output=True, text=True, timeout=120)
    assert done.returncode == 130 and done.stderr.splitlines()[-1] == "interrupted" and "Traceback" not in done.stderr
