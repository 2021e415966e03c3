"""The guard refuses what a backend ignores or lacks, naming the feature and the element."""

import mujoco
import pytest

from dexsim.core.errors import AssetError
from dexsim.physics.guard import check_model


def scene(
    *,
    actuator="",
    sensor="",
    joint="",
    geom='type="sphere" size=".01"',
    block='type="box" size=".01 .01 .01"',
    option="",
    extra="",
    world="",
):
    """A link that may meet a free block."""
    return f"""
    <mujoco>
      <option {option}/>{extra}
      <worldbody>{world}
        <body name="link">
          <joint name="knuckle" axis="0 1 0" {joint}/><geom name="tip" mass=".1" {geom}/><site name="patch"/>
        </body>
        <body name="thing" pos="0 0 1"><freejoint/><geom name="block" {block}/></body>
      </worldbody>
      <actuator>{actuator}</actuator>
      <sensor>{sensor}</sensor>
    </mujoco>"""


def motor(attributes):
    return f'<motor name="tendon" joint="knuckle" {attributes}/>'


PAIR = '<contact><pair geom1="tip" geom2="block"/></contact>'
MESH = '<asset><mesh name="wedge" vertex="0 0 0  .01 0 0  0 .01 0  0 0 .01"/></asset>'
CLOTH = (
    '<flexcomp name="cloth" type="grid" count="3 3 1" spacing=".01 .01 .01" mass=".1" dim="2" radius=".001">'
    '<edge equality="true"/></flexcomp>'
)

# What both backends, or our own actuator model in their place, would drop without a word.
IGNORED = {
    "actuator delay": (scene(actuator=motor('delay=".03" nsample="20"')), "tendon"),
    "actuator armature": (scene(actuator=motor('armature=".01"')), "tendon"),
    "actuator damping": (scene(actuator=motor('damping=".01"')), "tendon"),
    "dcmotor actuator": (
        scene(actuator='<dcmotor name="tendon" joint="knuckle" motorconst=".1" resistance="1"/>'),
        "tendon",
    ),
    "pid actuator": (scene(actuator='<pid name="tendon" joint="knuckle" kp="1" ki="1"/>'), "tendon"),
    "sensor delay or interval": (
        scene(sensor='<jointpos name="angle" joint="knuckle" delay=".03" nsample="20"/>'),
        "angle",
    ),
    "tactile sensor": (scene(extra=MESH, sensor='<tactile name="skin" geom="tip" mesh="wedge"/>'), "skin"),
    "polynomial joint damping": (scene(joint='damping=".1 .2"'), "knuckle"),
    "polynomial joint stiffness": (scene(joint='stiffness=".1 .2"'), "knuckle"),
    "flex bodies": (scene(world=CLOTH), ""),
    "fluid forces": (scene(option='density="1.2"'), "density"),
    "noslip iterations": (scene(option='noslip_iterations="3"'), ""),
    "flags that disable": (scene(extra='<option><flag limit="disable" contact="disable"/></option>'), "limit, contact"),
    "flag override": (scene(extra='<option o_solref="0.1 1"><flag override="enable"/></option>'), ""),
}
VARIANTS = {
    "actuator damping": scene(actuator=motor('damping="0 .01"')),
    "actuator delay": scene(actuator=motor('nsample="20"')),
    "sensor delay or interval": scene(sensor='<jointpos name="angle" joint="knuckle" interval=".03"/>'),
    "fluid forces": scene(option='viscosity="1e-5"'),
    "fluid forces ": scene(option='wind="1 0 0"'),
}
JAX_LACKS = {
    "contact sensor that matches bodies": (scene(sensor='<contact name="touch" body1="link" body2="thing"/>'), "touch"),
    "contact sensor that matches bodies ": (scene(sensor='<contact name="touch" site="patch"/>'), "touch"),
    "contact sensor with reduce=netforce": (
        scene(sensor='<contact name="touch" geom1="tip" geom2="block" reduce="netforce"/>'),
        "touch",
    ),
    "integrator discrete": (scene(option='integrator="discrete"'), ""),
    "collision cylinder-box": (scene(extra=PAIR, geom='type="cylinder" size=".01 .02"'), ""),
    "collision ellipsoid-box": (scene(extra=PAIR, geom='type="ellipsoid" size=".01 .02 .01"'), ""),
    "collision ellipsoid-mesh": (
        scene(extra=PAIR + MESH, geom='type="ellipsoid" size=".01 .02 .01"', block='type="mesh" mesh="wedge"'),
        "",
    ),
}


def refusal(xml, backend):
    with pytest.raises(AssetError) as caught:
        check_model(mujoco.MjModel.from_xml_string(xml), backend, "some/hand.xml")
    text = str(caught.value)
    assert text.startswith(f"some/hand.xml: backend {backend} cannot simulate: ") and "\n" not in text
    return text


@pytest.mark.parametrize("backend", ["jax", "warp"])
@pytest.mark.parametrize("feature", IGNORED)
def test_ignored_features_are_refused_on_both_backends(feature, backend):
    xml, element = IGNORED[feature]
    text = refusal(xml, backend)
    assert feature in text and element in text
    assert ";" not in text  # this feature and no other


@pytest.mark.parametrize("feature", VARIANTS)
def test_other_spellings_of_the_same(feature):
    assert feature.strip() in refusal(VARIANTS[feature], "jax")


@pytest.mark.parametrize("feature", JAX_LACKS)
def test_what_jax_lacks_is_refused_there(feature):
    xml, element = JAX_LACKS[feature]
    text = refusal(xml, "jax")
    assert element in text
    kinds = feature.strip().removeprefix("collision ")
    assert feature.strip() in text or f"collision {'-'.join(reversed(kinds.split('-')))}" in text
    check_model(mujoco.MjModel.from_xml_string(xml), "warp")


def test_the_pgs_solver_is_refused():
    for backend in ("jax", "warp"):
        assert "solver PGS" in refusal(scene(option='solver="PGS"'), backend)


def test_all_problems_are_named_at_once():
    xml = scene(
        actuator=motor('delay=".03" nsample="20" armature=".01"') + '<motor joint="knuckle" armature=".1"/>',
        joint='damping=".1 .2"',
        option='density="1.2"',
    )
    text = refusal(xml, "jax")
    for word in (
        "actuator delay (actuator tendon)",
        "actuator armature (actuator tendon, #1)",
        "polynomial joint damping (joint knuckle)",
        "fluid forces",
    ):
        assert word in text


@pytest.mark.parametrize("backend", ["jax", "warp"])
@pytest.mark.parametrize(
    "xml",
    [
        scene(),
        scene(
            actuator=motor('gear="2"'),
            sensor='<jointpos name="angle" joint="knuckle"/>',
            joint='damping=".1" stiffness=".1" armature=".01" frictionloss=".01"',
        ),
        scene(sensor='<contact name="touch" geom1="tip" geom2="block"/>'),
        scene(extra=PAIR),
        scene(extra=PAIR, block='type="capsule" size=".01 .02"'),
        scene(extra=PAIR, block='type="cylinder" size=".01 .02"'),
        scene(extra=PAIR, geom='type="capsule" size=".01 .02"', block='type="cylinder" size=".01 .02"'),
        scene(geom='type="cylinder" size=".01 .02"'),  # no explicit pair: it meets nothing in our scenes
    ],
    ids=[
        "plain",
        "drive and sensor",
        "contact by geom",
        "sphere-box",
        "sphere-capsule",
        "sphere-cylinder",
        "capsule-cylinder",
        "cylinder without a pair",
    ],
)
def test_what_the_backends_can_is_let_through(xml, backend):
    check_model(mujoco.MjModel.from_xml_string(xml), backend)


@pytest.mark.parametrize("backend", ["jax", "warp"])
def test_the_shipped_hand_passes(hand, backend):
    check_model(mujoco.MjModel.from_xml_path(str(hand.model_path)), backend, hand.model_path)
