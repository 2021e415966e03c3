"""Shows a shipped policy in the browser: simulated where JAX is installed, recorded episodes where it is not.

dexsim demo grasp
"""

from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Annotated

import tyro

from dexsim.core import cli
from dexsim.core.assets import asset_path
from dexsim.core.config import Config, setting
from dexsim.core.errors import ConfigError
from dexsim.view.__main__ import ViewArguments, show


@dataclass(frozen=True, kw_only=True)
class DemoArguments(Config):
    """Options of `dexsim demo`."""

    policy: Annotated[str, tyro.conf.Positional] = "grasp"
    """Name of a shipped policy."""
    host: str = "127.0.0.1"
    """Address to serve the page at."""
    port: int = setting(8080, unit="1", low=1, high=65535)
    """Port to serve the page at; the next free one if it is taken."""


def main(argv: Sequence[str] | None = None) -> int:
    """The command. Returns its exit code, 0."""
    arguments = cli.parse(DemoArguments, argv, prog="dexsim demo", description="Show a shipped policy in the browser.")
    recorded = {path.stem: str(path) for path in sorted(asset_path("episodes").glob("*.npz"))}
    what = arguments.policy if find_spec("jax") else recorded.get(arguments.policy)
    if what is None:
        raise ConfigError(f"{arguments.policy}: no recorded episodes: choose from {', '.join(recorded)}")
    return show(ViewArguments(what=what, host=arguments.host, port=arguments.port))


if __name__ == "__main__":
    cli.run(main)
