"""Fixtures of the bridge's tests."""

import pytest

from dexsim_real.control.controller import Controller

CONTROLLERS = {}


@pytest.fixture
def jax_as_it_is(monkeypatch):
    """Runs within the tests' process leave the flags that other tests compile with alone, and share compiled code."""

    def controller(policy, hand):
        key = policy.task, hand.name
        if key not in CONTROLLERS:
            CONTROLLERS[key] = Controller(policy, hand)
        return CONTROLLERS[key]

    monkeypatch.setattr("dexsim_real.run.session.Controller", controller)
    monkeypatch.setattr("dexsim_real.run.session.prepare_jax", lambda: None)
    monkeypatch.setattr("dexsim_real.replay.__main__.prepare_jax", lambda: None)
