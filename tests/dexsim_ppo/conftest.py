"""What tests of the learner's commands and files share."""

import jax
import pytest
import tiny_train
from tiny_env import TinyEnv, training_of

from dexsim_ppo.policy import Policy


@pytest.fixture
def tiny_task(monkeypatch):
    """The integrator among the tasks."""
    tiny_train.install(monkeypatch)


@pytest.fixture(scope="session")
def policy():
    """Of the integrator, hardly trained."""
    training = training_of()
    state, _ = training.step(training.init(jax.random.key(0)))
    return Policy.from_training(TinyEnv(), state, {"seed": 0})
