"""The console command `dexsim`: one word for each of the library's commands.

dexsim train --task grasp        # the same as python -m dexsim_ppo.train --task grasp
"""

import difflib
import importlib
import sys
from collections.abc import Sequence

from dexsim.core import cli
from dexsim.core.install import require
from dexsim.core.lazy_loading import exit_on_interrupt, restore_interrupt
from dexsim.errors import ConfigError

COMMANDS = {
    "tasks": ("dexsim.registry", "list tasks, hands and shipped policies"),
    "train": ("dexsim_ppo.train", "train a task"),
    "evaluate": ("dexsim_ppo.evaluate", "measure a policy over fixed episodes"),
    "demo": ("dexsim.view.__main__", "show a trained hand in the browser, without JAX too"),
    "view": ("dexsim.view.__main__", "the same, of a policy, task or log of your own"),
    "export": ("dexsim_ppo.export", "write a policy as an ONNX model or a bundle"),
    "record": ("dexsim_ppo.record", "record simulated episodes for other programs"),
    "run": ("dexsim_real.run", "run a policy on the hand"),
    "ros": ("dexsim_real.ros", "a hand as a ROS 2 node"),
    "twin": ("dexsim_real.twin.__main__", "emulate a hand on a pseudo-terminal"),
    "calibrate": ("dexsim_real.calibrate.__main__", "calibrate a hand"),
    "replay": ("dexsim_real.replay", "recompute and plot the log of a run"),
    "check-hand": ("dexsim.check_hand", "check the files of a hand"),
    "import-hand": ("dexsim.import_hand", "make a hand's folder from a URDF or MJCF, or its mirror image"),
}
"""Module and purpose of each command."""
WITHOUT_JAX = ("demo", "view")


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command. Returns its exit code. Raises ConfigError: no such command."""
    argv = list(sys.argv[1:] if argv is None else argv)
    if not argv or argv[0] in ("-h", "--help"):
        print("usage: dexsim COMMAND [options]\n")
        for command, (_, purpose) in COMMANDS.items():
            print(f"  {command:12} {purpose}")
        print("\ndexsim COMMAND --help shows the command's options.")
        return 0
    name, *rest = argv
    if name not in COMMANDS:
        meant = "".join(f" (perhaps {near})" for near in difflib.get_close_matches(name, COMMANDS, n=1))
        raise ConfigError(f"{name}: no such command{meant}; see dexsim --help")
    if name not in WITHOUT_JAX:
        require("jax", "train", f"dexsim {name}")
    if name == "train":
        cli.announce_loading()
    exit_on_interrupt()
    module = importlib.import_module(COMMANDS[name][0])
    restore_interrupt()
    return module.main(rest)


def console() -> None:
    """The entry point of the console command."""
    sys.path.insert(0, "")  # As `python -m` does: `--task my_module:make_env` is found in the current folder.
    cli.run(main)


if __name__ == "__main__":
    console()
