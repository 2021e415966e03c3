"""Shows a hand live in the browser.

    python -m dexsim.view grasp        # dexsim demo grasp

Shown is a simulation with a policy, the emulated hand (`--emulated`), the log of a run on a hand, or recorded episodes.
"""

import dataclasses
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from dexsim.core import cli
from dexsim.core.assets import asset_path
from dexsim.core.config import Config, setting
from dexsim.core.install import require
from dexsim.errors import CheckpointError, ConfigError

if TYPE_CHECKING:
    from dexsim.view.viewer import Source


@dataclasses.dataclass(frozen=True, kw_only=True)
class ViewArguments(Config):
    """Show a hand live in the browser."""

    what: Annotated[str, tyro.conf.Positional] = "grasp"
    """Policy file, name of a shipped policy or of a task (my_module:poke for one of your own), log file (.log) of a run
    on a hand, or episodes (.npz) of `dexsim record`. Without JAX a shipped policy is shown by recorded episodes."""
    emulated: bool = False
    """Run the policy on the emulated hand instead of the simulation that it was trained in."""
    hand: str = ""
    """The TOML of a hand of your own, or the name of a shipped one; empty for the one that the policy or the log is of.
    With the name of a task: the task on that hand."""
    seed: int = setting(0, unit="1", low=0, high=2**31 - 1)
    """Seed of the episodes."""
    host: str = "127.0.0.1"
    """Address to serve the page at; 0.0.0.0 lets other computers see and control it."""
    port: int = setting(8080, unit="1", low=1, high=65535)
    """Port to serve the page at; the next free one if it is taken."""


def open_source(arguments: ViewArguments) -> "Source":
    """What the arguments ask to be shown. Raises DexsimError: it cannot be."""
    name = arguments.what
    if name.endswith((".npz", ".log")):
        from dexsim.datasets.episodes import read_episodes
        from dexsim.view.recording import Recording, read_log

        read = read_log if name.endswith(".log") else read_episodes
        return Recording(read(Path(name), arguments.hand))
    if arguments.emulated:
        from dexsim.view.emulation import Emulation

        return Emulation(name, arguments.seed, arguments.hand)
    from dexsim.hand.load import load_hand
    from dexsim.registry import make
    from dexsim.view.simulation import NONE, Simulation, find_policies
    from dexsim_ppo.policy import load_policy

    try:
        policy = load_policy(name)
        hand = policy.find_hand(arguments.hand)
    except (CheckpointError, ConfigError) as error:
        # "grasp" is a task and also a policy, which is of the XHand: on another hand the task is shown.
        if Path(name).exists() or (isinstance(error, ConfigError) and not arguments.hand):
            raise
        env, name = make(name, hand=load_hand(arguments.hand or None)), NONE
    else:
        env = policy.make_env(hand=hand)
    return Simulation(env, find_policies(env, name), arguments.seed)


def main(argv: Sequence[str] | None = None) -> int:
    """The command: serves the page until Ctrl-C. Returns its exit code, 0."""
    arguments = cli.parse(ViewArguments, argv)
    recorded = asset_path("episodes") / f"{arguments.what}.npz"
    if recorded.is_file() and not find_spec("jax"):
        arguments = dataclasses.replace(arguments, what=str(recorded))
    if not arguments.what.endswith(".npz"):
        require("jax", "train", f"showing {arguments.what}")
        print(f"preparing {arguments.what}: compiling takes up to a minute, the first time", flush=True)
        cli.enable_caches()
    source = open_source(arguments)
    from dexsim.view.viewer import Viewer

    title = f"dexsim: {Path(arguments.what).stem}"
    viewer = Viewer(source, title=title, host=arguments.host, port=arguments.port)
    print(f"open {viewer.url} in a browser; Ctrl-C ends", flush=True)
    viewer.run()
    return 0


if __name__ == "__main__":
    cli.run(main)
