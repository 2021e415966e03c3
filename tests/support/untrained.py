"""A grasp policy of any hand before its training: random weights, and everything else as a training writes it."""

import dataclasses

import jax
import jax.numpy as jnp

from dexsim.core.config import to_dict
from dexsim.hand.source import record_of
from dexsim.observation import ObservationConfig, layout
from dexsim.registry import make_task
from dexsim.task_spec import TaskSpec
from dexsim.tasks.grasp.config import GraspConfig
from dexsim_ppo.learner.networks import init_mlp
from dexsim_ppo.learner.running_stats import Normalizer
from dexsim_ppo.policy import Policy, PolicyParams


def untrained(hand, path=None, force_loop=True, **observation):
    config = GraspConfig(observation=ObservationConfig(**observation))
    if not force_loop:
        loop = dataclasses.replace(config.control.force, gain=0.0)
        config = dataclasses.replace(config, control=dataclasses.replace(config.control, force=loop))
    task = make_task("grasp", hand, config)
    spec = TaskSpec.of(task)
    fields = layout(hand, spec.fields, spec.observation)
    size = sum(field.size for field in fields)
    layers = init_mlp(jax.random.key(0), (size, 8, hand.num_joints), 0.3)
    policy = Policy(
        task="grasp",
        env_config=to_dict(task.config),
        observation_layout=fields,
        params=PolicyParams(layers, Normalizer(jnp.zeros(size), jnp.ones(size))),
        control_rate=100 / 3,
        spec=spec,
        hand=record_of(hand),
    )
    if path is not None:
        policy.save(path)
    return policy
