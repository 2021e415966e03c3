"""A task that is not of the library: grasp with another configuration. Importing this registers it."""

import dataclasses

import dexsim
from dexsim.core.config import setting
from dexsim.hand.description import Hand
from dexsim.tasks.grasp.config import GraspConfig
from dexsim.tasks.grasp.task import Grasp


@dataclasses.dataclass(frozen=True, kw_only=True)
class PokeConfig(GraspConfig):
    """The poke task."""

    gain: float = setting(3.0, unit="1", low=0.0, high=10.0)
    """A setting of its own."""


class Poke(Grasp):
    """The rules."""

    name = "poke"

    def __init__(self, config: PokeConfig, hand: Hand):
        super().__init__(config, hand)


dexsim.register("poke", Poke)
