"""From actions to joint targets, and what of them an observation shows."""

import jax.numpy as jnp
import numpy as np
import pytest

from dexsim.control import Control, move_target, observed_action
from dexsim.core.errors import ConfigError


def test_a_target_moves_by_the_action_within_reach_and_limits(hand):
    """Joint by joint: free, held back by reach on either side, by the end stop on either side; in this order."""
    control = Control(step=0.2, reach=0.3)
    lower, upper = (np.asarray(x, np.float32) for x in (hand.joint_lower, hand.joint_upper))
    middle = (lower + upper) / 2
    target, measured, action = middle.copy(), middle.copy(), np.zeros(12, np.float32)
    wanted = middle.copy()
    action[0], wanted[0] = -0.5, middle[0] - 0.1
    measured[4], action[4], wanted[4] = middle[4] - 0.25, 1.0, middle[4] + 0.05
    measured[5], action[5], wanted[5] = middle[5] + 0.25, -1.0, middle[5] - 0.05
    target[6] = measured[6] = upper[6] - 0.1
    action[6], wanted[6] = 1.0, upper[6]
    target[7] = measured[7] = lower[7] + 0.1
    action[7], wanted[7] = -1.0, lower[7]
    # A target left far behind by its joint comes after it without any action.
    measured[8], wanted[8] = middle[8] + 0.5, middle[8] + 0.2
    # A joint pushed beyond its stop does not take the target with it.
    target[9] = upper[9]
    measured[9], wanted[9] = upper[9] + 0.4, upper[9]
    found = move_target(control, hand, *(jnp.asarray(x) for x in (target, action, measured)))
    np.testing.assert_allclose(found, wanted, atol=1e-6)


def test_a_recalled_target_is_a_place_in_its_joints_range(hand):
    lower, upper = (np.asarray(x, np.float32) for x in (hand.joint_lower, hand.joint_upper))
    action = jnp.linspace(-1, 1, 12)
    for share, place in ((0.0, -1.0), (0.5, 0.0), (0.75, 0.5), (1.0, 1.0)):
        target = jnp.asarray(lower + share * (upper - lower))
        found = observed_action(Control(last_action_encoding="target"), hand, action, target)
        np.testing.assert_allclose(found, np.full(12, place), atol=1e-5)
        np.testing.assert_array_equal(observed_action(Control(), hand, action, target), action)
    with pytest.raises(ConfigError, match="last_action_encoding = 'nothing': choose from action, target"):
        Control(last_action_encoding="nothing")
