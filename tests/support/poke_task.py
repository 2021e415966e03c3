"""A task that is not of the library: grasp with another reward and configuration. Importing this registers it."""

import dataclasses

import dexsim
from dexsim.core.config import setting
from dexsim.hand.description import Hand
from dexsim.objects.config import ObjectConfig
from dexsim.tasks.grasp.config import GraspConfig
from dexsim.tasks.grasp.task import Grasp


@dataclasses.dataclass(frozen=True, kw_only=True)
class PokeConfig(GraspConfig):
    """The poke task."""

    objects: ObjectConfig = setting(ObjectConfig(shapes=("sphere",)))
    """What is poked."""
    pool_size: int = setting(4, unit="1", low=1, high=1000)
    """Start states."""
    episode_seconds: float = setting(0.6, unit="s", low=0.2, high=10.0)
    """Time limit of a training episode."""
    evaluation_seconds: float = setting(0.6, unit="s", low=0.2, high=10.0)
    """Length of an evaluation episode."""
    gain: float = setting(3.0, unit="1", low=0.0, high=10.0)
    """Factor on grasp's reward."""


class Poke(Grasp):
    """The rules."""

    name = "poke"

    def __init__(self, config: PokeConfig, hand: Hand):
        super().__init__(config, hand)

    def reward(self, goal, truth, dropped):
        reward, metrics = super().reward(goal, truth, dropped)
        return self.config.gain * reward, metrics


dexsim.register("poke", Poke)
