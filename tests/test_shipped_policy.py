"""The policy in assets/policies: loads without a simulator, fits today's task, and acts."""

import json

import jax.numpy as jnp
import numpy as np

from dexsim.assets import asset_path
from dexsim.config import from_dict
from dexsim.observation import GRASP, layout
from dexsim.tasks.grasp import GraspConfig
from dexsim_ppo.policy import Policy, layout_to_list


def test_it_fits_the_task_and_the_hand(hand):
    policy = Policy.load(asset_path("policies/grasp.msgpack"))
    config = from_dict(GraspConfig, policy.env_config)
    fields = layout(hand, GRASP, config.observation)
    assert layout_to_list(policy.observation_layout) == layout_to_list(fields)
    size = sum(field.size for field in fields)
    assert size == 66
    low = np.asarray(policy(jnp.zeros(size)))
    high = np.asarray(policy(jnp.zeros(size).at[-1].set(1.0)))
    assert low.shape == (hand.num_joints,) and np.all(np.abs(low) <= 1.0)
    assert np.max(np.abs(high - low)) > 1e-3  # the command is heard


def test_its_report_is_of_this_file_and_says_how_it_came_about():
    report = json.loads(asset_path("policies/grasp.json").read_text())
    policy = Policy.load(asset_path("policies/grasp.msgpack"))
    assert report["origin"]["env_steps"] == policy.training["env_steps"]
    assert report["origin"]["seed"] == policy.training["seed"]
    for key in ("command", "hardware", "versions", "trained", "untrained"):
        assert report[key]
