"""Fixtures of the bridge's tests."""

import jax
import numpy as np
import pytest
from virtual_time import VirtualTime

from dexsim import load_hand
from dexsim_real.control.controller import Controller


@pytest.fixture(scope="session")
def leap():
    return load_hand("leap_like")


@pytest.fixture(scope="session")
def controller_of():
    """The controller of a policy on a hand, compiled once for all tests."""
    made = {}

    def controller(policy, hand, axis=()):
        weights = b"".join(np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(policy.params))
        key = policy.task, hand.name, hash(weights), axis
        if key not in made:
            made[key] = Controller(policy, hand, axis)
        return made[key]

    return controller


@pytest.fixture
def jax_as_it_is(monkeypatch, controller_of):
    """Runs within the tests' process leave the flags that other tests compile with alone."""
    monkeypatch.setattr("dexsim_real.run.Controller", controller_of)
    monkeypatch.setattr("dexsim_real.run.prepare_jax", lambda: None)
    monkeypatch.setattr("dexsim_real.replay.prepare_jax", lambda: None)


@pytest.fixture
def virtual_time(monkeypatch):
    """Runs in virtual time."""
    clock = VirtualTime()
    clock.install(monkeypatch)
    return clock
