"""The policies in assets/policies: load without a simulator, fit today's tasks, and act."""

import json

import jax.numpy as jnp
import numpy as np
import pytest

from dexsim.core.assets import asset_path
from dexsim.core.config import from_dict
from dexsim.core.errors import ConfigError
from dexsim.observation import GRASP, ROTATE, layout
from dexsim.registry import TASKS
from dexsim_ppo.policy import Policy, layout_to_list
from dexsim_real.sensors.readings import sources_of

SHIPPED = {
    "grasp": (GRASP, 66),
    "rotate": (ROTATE, 65),
    "rotate_without_orientation": (ROTATE, 59),
    "rotate_clear": (ROTATE, 65),
}


def load(name):
    return Policy.load(asset_path(f"policies/{name}.msgpack"))


@pytest.mark.parametrize("name", SHIPPED)
def test_it_fits_the_task_and_the_hand(hand, name):
    policy, (names, size) = load(name), SHIPPED[name]
    config = from_dict(TASKS[policy.task].config_class, policy.env_config)
    fields = layout(hand, names, config.observation)
    assert layout_to_list(policy.observation_layout) == layout_to_list(fields)
    assert sum(field.size for field in fields) == size
    action = np.asarray(policy(jnp.zeros(size)))
    assert action.shape == (hand.num_joints,) and np.all(np.abs(action) <= 1.0)
    assert policy.control_rate == pytest.approx(1 / config.physics.control_period)


def test_the_command_is_heard():
    low, high = (np.asarray(load("grasp")(jnp.zeros(66).at[-1].set(c))) for c in (0.0, 1.0))
    assert np.max(np.abs(high - low)) > 1e-3


def test_the_goal_is_seen():
    fields = [field.name for field in load("rotate").observation_layout]
    assert fields[1] == "relative_orientation"
    near, far = (
        np.asarray(load("rotate")(jnp.zeros(65).at[12:18].set(jnp.array(sixd))))
        for sixd in ([1.0, 0, 0, 0, 1, 0], [1.0, 0, 0, 0, 0, 1])
    )
    assert np.max(np.abs(near - far)) > 1e-3


@pytest.mark.parametrize(
    ("name", "sources"),
    [
        ("grasp", {"hand", "camera", "user"}),
        ("rotate", {"hand", "imu", "policy"}),
        ("rotate_without_orientation", {"hand", "policy"}),
    ],
)
def test_the_sensors_it_needs(name, sources):
    assert sources_of([field.name for field in load(name).observation_layout]) == sources


@pytest.mark.parametrize("name", SHIPPED)
def test_its_report_is_of_this_file_and_says_how_it_came_about(name):
    report = json.loads(asset_path(f"policies/{name}.json").read_text())
    policy = load(name)
    assert report["origin"]["env_steps"] == policy.training["env_steps"]
    assert report["origin"]["seed"] == policy.training["seed"]
    for key in ("command", "hardware", "versions", "trained", "untrained"):
        assert report[key]
    # Else what the emulated hand draws outside the ranges would not be outside for it.
    assert not report["arguments"]["env"]["randomization"].get("beyond") and "beyond" not in report["command"]


def test_an_ablated_policy_takes_the_mean_of_what_it_does_not_see():
    policy = load("rotate")
    names = ("contact_force", "relative_orientation")
    hidden = np.concatenate([np.full(f.size, f.name in names) for f in policy.observation_layout])
    obs = np.random.default_rng(0).normal(size=(20, 65)).astype(np.float32)
    mean = np.asarray(policy.params.normalizer.mean)
    ablated = policy.ablate(*names)
    np.testing.assert_allclose(ablated(obs), policy(np.where(hidden, mean, obs)), atol=2e-5)
    np.testing.assert_array_equal(ablated(obs), ablated(np.where(hidden, 9.0, obs)))
    assert np.max(np.abs(np.asarray(ablated(obs)) - np.asarray(policy(obs)))) > 0.1
    np.testing.assert_array_equal(policy.ablate()(obs), policy(obs))
    with pytest.raises(ConfigError, match="does not observe colour; it observes .*joint_position"):
        policy.ablate("colour")
