"""Choosing an engine; a guard that names what the physics would drop."""

import types

import jax
import mujoco
import pytest

from dexsim.core.errors import AssetError, ConfigError
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


def scene(*, actuator="", sensor="", joint="", option="", extra="", world=""):
    """A link with a joint, and a free block."""
    return mujoco.MjModel.from_xml_string(f"""
    <mujoco>
      <option {option}/>{extra}
      <worldbody>{world}
        <body name="link">
          <joint name="knuckle" axis="0 1 0" {joint}/><geom name="tip" mass=".1" size=".01"/>
        </body>
        <body name="thing" pos="0 0 1"><freejoint/><geom name="block" type="box" size=".01 .01 .01"/></body>
      </worldbody>
      <actuator>{actuator}</actuator>
      <sensor>{sensor}</sensor>
    </mujoco>""")


def motor(attributes):
    return f'<motor name="tendon" joint="knuckle" {attributes}/>'


DC_MOTOR = '<dcmotor name="tendon" joint="knuckle" motorconst=".1" resistance="1"/>'
MESH = '<asset><mesh name="wedge" vertex="0 0 0  .01 0 0  0 .01 0  0 0 .01"/></asset>'
CLOTH = (
    '<flexcomp name="cloth" type="grid" count="3 3 1" spacing=".01 .01 .01" mass=".1" dim="2" radius=".001">'
    '<edge equality="true"/></flexcomp>'
)
IGNORED = [
    ({"actuator": motor('delay=".03" nsample="20"')}, "actuator delay"),
    ({"actuator": motor('nsample="20"')}, "actuator delay"),
    ({"actuator": motor('armature=".01"')}, "actuator armature"),
    ({"actuator": motor('damping=".01"')}, "actuator damping"),
    ({"actuator": motor('damping="0 .01"')}, "actuator damping"),
    ({"actuator": DC_MOTOR}, "dcmotor or pid actuators"),
    ({"actuator": '<pid name="tendon" joint="knuckle" kp="1" ki="1"/>'}, "dcmotor or pid actuators"),
    ({"sensor": '<jointpos name="angle" joint="knuckle" interval=".03"/>'}, "sensor delay or interval"),
    ({"extra": MESH, "sensor": '<tactile name="skin" geom="tip" mesh="wedge"/>'}, "tactile sensors"),
    ({"joint": 'damping=".1 .2"'}, "polynomial joint damping"),
    ({"joint": 'stiffness=".1 .2"'}, "polynomial joint stiffness"),
    ({"world": CLOTH}, "flex bodies"),
    ({"option": 'density="1.2"'}, "fluid forces"),
    ({"option": 'viscosity="1e-5"'}, "fluid forces"),
    ({"option": 'wind="1 0 0"'}, "fluid forces"),
    ({"option": 'noslip_iterations="3"'}, "noslip iterations"),
    ({"extra": '<option><flag limit="disable" contact="disable"/></option>'}, "flags that disable limit, contact"),
    ({"extra": '<option o_solref="0.1 1"><flag override="enable"/></option>'}, "flag override"),
]


@pytest.mark.parametrize(("parts", "feature"), IGNORED)
def test_ignored_features_are_refused(parts, feature):
    with pytest.raises(AssetError) as error:
        check_model(scene(**parts), "some/hand.xml")
    text = str(error.value)
    assert text.startswith("some/hand.xml: cannot simulate: ") and feature in text
    assert ";" not in text  # this feature and no other


def test_what_the_engines_simulate_passes(hand):
    joint = 'damping=".1" stiffness=".1" armature=".01" frictionloss=".01"'
    check_model(scene(actuator=motor('gear="2"'), sensor='<jointpos joint="knuckle"/>', joint=joint))
    check_model(mujoco.MjModel.from_xml_path(str(hand.model_path)))
