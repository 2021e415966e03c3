"""The command `dexsim tasks`: what there is to train, on which hands, and which policies are shipped."""

from collections.abc import Sequence

from dexsim.core import cli
from dexsim.core.assets import asset_path
from dexsim.hand.load import DEFAULT, shipped_hands
from dexsim.registry import TASKS


def catalog() -> dict[str, list[str]]:
    """Names of tasks, hands and shipped policies."""
    policies = [path.stem for path in asset_path("policies").glob("*.msgpack")]
    return {"tasks": sorted(TASKS), "hands": sorted(shipped_hands()), "policies": sorted(policies)}


def main(argv: Sequence[str] | None = None) -> int:
    """The command, which has no options. Returns its exit code."""
    del argv
    for kind, names in catalog().items():
        print(f"{kind + ':':10}{', '.join(f'{name} (default)' if name == DEFAULT else name for name in names)}")
    return 0


if __name__ == "__main__":
    cli.run(main)
