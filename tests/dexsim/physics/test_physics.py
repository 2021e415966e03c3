"""Choosing an engine; a guard that names what the physics would drop."""

import types

import jax
import mujoco
import pytest

from dexsim.errors import AssetError, ConfigError
from dexsim.physics.model import check_model
from dexsim.physics.physics import choose_backend


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


PLAIN = """
<mujoco>
  <worldbody>
    <body name="link">
      <joint name="knuckle" damping=".1" stiffness=".1" armature=".01" frictionloss=".01"/>
      <geom name="tip" mass=".1" size=".01"/>
    </body>
  </worldbody>
  <actuator><motor joint="knuckle" gear="2"/></actuator>
  <sensor><jointpos joint="knuckle"/></sensor>
</mujoco>"""
CLOTH = '<flexcomp name="cloth" type="grid" count="3 3 1" spacing=".01 .01 .01" mass=".1" dim="2" radius=".001"/>'
# What is added to the model, and what is said of it.
IGNORED = {
    "<worldbody>": (f"<worldbody>{CLOTH}", "flex bodies"),
    'damping=".1"': ('damping=".1 .2"', "polynomial joint damping"),
    'stiffness=".1"': ('stiffness=".1 .2"', "polynomial joint stiffness"),
    'gear="2"/>': (
        'delay=".03" nsample="20" armature=".01" damping="0 .01"/><pid joint="knuckle" kp="1" ki="1"/>',
        "actuator delay; actuator armature; actuator damping; dcmotor or pid actuators",
    ),
    'name="link"': ('name="object_2"', "names object, object_0, … (reserved)"),
    "</sensor>": ('<tactile geom="tip" mesh="wedge"/></sensor>', "tactile sensors"),
    '<jointpos joint="knuckle"': ('<jointpos joint="knuckle" interval=".03"', "sensor delay or interval"),
    "</mujoco>": (
        """<option viscosity="1e-5" noslip_iterations="3" o_solref="0.1 1">
        <flag limit="disable" contact="disable" override="enable"/></option>
        <asset><mesh name="wedge" vertex="0 0 0  .01 0 0  0 .01 0  0 0 .01"/></asset></mujoco>""",
        "fluid forces (density, viscosity, wind); noslip iterations; <option> disables limit, contact; flag override",
    ),
}


def test_what_the_engines_ignore_is_named_and_what_they_simulate_passes(hand):
    check_model(mujoco.MjModel.from_xml_string(PLAIN))
    check_model(mujoco.MjModel.from_xml_path(str(hand.model_path)))
    text, features = PLAIN, []
    for old, (new, says) in IGNORED.items():
        text = text.replace(old, new)
        features += says.split("; ")
    with pytest.raises(AssetError, match="^some/hand.xml: cannot simulate: ") as error:
        check_model(mujoco.MjModel.from_xml_string(text), "some/hand.xml")
    assert sorted(str(error.value).partition("simulate: ")[2].split("; ")) == sorted(features)
