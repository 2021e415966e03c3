"""Fixtures of the bridge's tests."""

import pytest


@pytest.fixture
def jax_as_it_is(monkeypatch):
    """Runs within the tests' process leave the flags that other tests compile with alone."""
    monkeypatch.setattr("dexsim_real.run.session.prepare_jax", lambda: None)
    monkeypatch.setattr("dexsim_real.replay.__main__.prepare_jax", lambda: None)
