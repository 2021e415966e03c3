"""Choosing an engine, and building its scene."""

import shutil
import types

import jax
import pytest

from dexsim.core.errors import AssetError, ConfigError
from dexsim.hand.load import load_hand
from dexsim.objects.config import SLOTS, ObjectConfig
from dexsim.physics.config import PhysicsConfig
from dexsim.physics.physics import Physics, choose_backend

GRAVITY = (9.81, 0.0, 0.0)


def make(hand):
    return Physics(hand, SLOTS, ObjectConfig().largest, PhysicsConfig(), gravity=GRAVITY, backend="c")


def test_backends(monkeypatch):
    with pytest.raises(ConfigError, match="'metal'.*auto, c, cuda, mjx"):
        choose_backend("metal")
    monkeypatch.setattr(jax, "default_backend", lambda: "cpu")
    assert choose_backend("auto") == choose_backend("c") == "c" and choose_backend("mjx") == "mjx"
    with pytest.raises(ConfigError, match=r"'cuda' needs an NVIDIA GPU.*pip install .*\[cuda\]"):
        choose_backend("cuda")
    monkeypatch.setattr(jax, "default_backend", lambda: "tpu")
    assert choose_backend("auto") == "mjx"
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    for runtime, chosen in (("rocm 60300", "mjx"), ("cuda 13000", "cuda")):
        device = types.SimpleNamespace(client=types.SimpleNamespace(platform_version=runtime))
        monkeypatch.setattr(jax, "devices", lambda device=device: [device])
        assert choose_backend("auto") == chosen
    with pytest.raises(ConfigError, match="JAX_PLATFORMS=cpu"):
        choose_backend("c")


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"timestep": 0.5}, "0.5 s: must be between 0.0001 and 0.01 s"),
        ({"substeps": 200}, "0.01 s times substeps = 200 is a control tick of 2 s: must be from 0.001 to 1 s"),
        ({"timestep": 1e-4}, "a control tick of 0.0003 s"),
        ({"iterations": -1}, "iterations"),
    ],
)
def test_configurations_that_are_refused(changes, message):
    with pytest.raises(ConfigError, match=message):
        PhysicsConfig(**changes)


def test_a_model_without_named_contact_geoms(hand, tmp_path):
    shutil.copytree(hand.model_path.parent, tmp_path, dirs_exist_ok=True)
    path = tmp_path / hand.model_path.name
    path.write_text(path.read_text().replace('name="ring_link1" class', "class"))
    with pytest.raises(AssetError, match=f"{path}.*needs a name"):
        make(load_hand(tmp_path / "xhand_right.toml"))
