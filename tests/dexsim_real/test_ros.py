"""The ROS 2 node with a stand-in of rclpy and of the messages that it uses: what it publishes, commands through the
safety, and how it ends."""

import dataclasses
import sys
import types
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from scripted_driver import ScriptedDriver

from dexsim.hand.kinematics import forward_kinematics, taxel_normals, taxel_positions
from dexsim_real import ros

STEP = 0.012  # s


def message(name, /, **fields):
    """A class of messages as ROS defines them: fields with the makers of their first values; no others."""
    made = [(field, object, dataclasses.field(default_factory=first)) for field, first in fields.items()]
    return dataclasses.make_dataclass(name, made, slots=True)


Header = message("Header", stamp=lambda: None, frame_id=str)
Vector3 = message("Vector3", x=float, y=float, z=float)
Wrench = message("Wrench", force=Vector3, torque=Vector3)
MultiArrayDimension = message("MultiArrayDimension", label=str, size=int, stride=int)
MultiArrayLayout = message("MultiArrayLayout", dim=list, data_offset=int)
PACKAGES = {
    "geometry_msgs.msg": [message("WrenchStamped", header=Header, wrench=Wrench)],
    "sensor_msgs.msg": [message("JointState", header=Header, name=list, position=list, velocity=list, effort=list)],
    "std_msgs.msg": [
        message("Float32MultiArray", layout=MultiArrayLayout, data=list),
        message("Float64MultiArray", layout=MultiArrayLayout, data=list),
        MultiArrayDimension,
    ],
    "std_srvs.srv": [message("SetBool")],
}


class Node:
    """A node without a middleware. `topics` has the published messages by topic."""

    def __init__(self, name, **parameters):
        self.name, self.parameters = name, parameters
        self.topics, self.subscriptions, self.services, self.timers, self.said = {}, {}, {}, [], []

    def declare_parameter(self, name, default):
        return SimpleNamespace(value=self.parameters.get(name, default))

    def create_publisher(self, kind, topic, depth):
        kept = self.topics.setdefault(topic, [])

        def publish(given):
            assert type(given) is kind
            kept.append(given)

        return SimpleNamespace(publish=publish)

    def create_subscription(self, kind, topic, call, depth):
        self.subscriptions[topic] = kind, call

    def create_service(self, kind, name, call):
        self.services[name] = call

    def create_timer(self, period, call):
        self.timers.append((period, call))

    def get_logger(self):
        return SimpleNamespace(info=self.said.append, error=self.said.append)

    def get_clock(self):
        return SimpleNamespace(now=lambda: SimpleNamespace(to_msg=lambda: "now"))

    def destroy_node(self):
        self.said.append("destroyed")


def install(patch, node, spin):
    """Put the modules in place for as long as a `pytest.MonkeyPatch` lasts; `rclpy.spin` is `spin`."""
    for name, classes in PACKAGES.items():
        package, _, _ = name.partition(".")
        module = types.ModuleType(name)
        vars(module).update({kind.__name__: kind for kind in classes})
        patch.setitem(sys.modules, package, types.ModuleType(package))
        patch.setitem(sys.modules, name, module)
    rclpy = types.ModuleType("rclpy")
    rclpy.init = rclpy.try_shutdown = lambda: None
    rclpy.create_node = lambda name: node
    rclpy.spin = spin
    patch.setitem(sys.modules, "rclpy", rclpy)


def follower(hand, measures=("currents", "taxels")):
    """Joints that go a third of the way at each answer."""
    driver = ScriptedDriver(hand, measures, 1 / 3)
    if "currents" in measures:
        driver.state.current[:] = -0.2
    return driver


@pytest.fixture
def make(monkeypatch, leap):
    """A node over a driver, whose exchange loop the test turns in its own time."""

    def make(driver, options="--no-guard"):
        monkeypatch.setitem(sys.modules, "my_sdk", SimpleNamespace(open_hand=lambda hand, config: driver))
        node = Node("dexsim_hand", port="sdk:my_sdk", hand="leap_like", options=options)
        install(monkeypatch, node, lambda node: None)
        now = [0.0]
        hand = ros.HandNode(node)
        hand.loop.clock = hand.port._clock = lambda: now[0]
        hand.loop.pace._sleep = lambda seconds: None
        hand.loop.start = lambda: None
        hand.start()

        def turn(cycles, before=lambda: None):
            for _ in range(cycles):
                now[0] += STEP
                before()
                hand.loop.cycle()
                for _, call in node.timers:
                    call()

        return node, hand, turn

    return make


def test_joint_states_wrenches_and_taxels_are_those_of_the_hand(make, leap):
    driver = follower(leap)
    node, hand, turn = make(driver)
    driver.state.taxel_force[1, 5:9] = 1.5
    turn(12)
    joints = node.topics["joint_states"][-1]
    assert joints.name == list(leap.joint_names) and joints.header.stamp == "now"
    np.testing.assert_allclose(joints.position, driver.state.position, atol=1e-6)
    np.testing.assert_allclose(joints.effort, 0.2 * leap.torque_limit, rtol=1e-5)  # -0.2 A, by the default scale
    array = node.topics["~/taxels"][-1]
    assert [(dim.label, dim.size, dim.stride) for dim in array.layout.dim] == [("finger", 4, 192), ("taxel", 48, 48)]
    np.testing.assert_allclose(np.reshape(array.data, (4, 48)), driver.state.taxel_force, rtol=1e-5)
    # Against the palm frame's taxels: the same force and torque, turned into the frame of the tip's body.
    pose = jax.jit(forward_kinematics, static_argnums=0)(leap, hand.safety.sample.measured.joint_position)
    force = -1.5 * np.array(taxel_normals(leap, pose))[1, 5:9]
    lever = np.array(taxel_positions(leap, pose))[1, 5:9] - np.array(pose.body_position)[leap.tip_body[1]]
    turned = np.array(pose.body_rotation)[leap.tip_body[1]]
    wrench = node.topics["~/wrenches/index"][-1]
    assert wrench.header.frame_id == leap.body_names[leap.tip_body[1]]
    for vector, palm in ((wrench.wrench.force, force), (wrench.wrench.torque, np.cross(lever, force))):
        np.testing.assert_allclose(turned @ [vector.x, vector.y, vector.z], palm.sum(0), atol=1e-5)
    assert node.topics["~/wrenches/thumb"][-1].wrench.force.x == 0.0
    shown = len(node.topics["joint_states"])
    node.timers[0][1]()
    assert len(node.topics["joint_states"]) == shown, "a measurement is published once"


def test_commands_move_the_hand_within_the_safety_until_their_stream_ends(make, leap):
    driver = follower(leap)
    node, hand, turn = make(driver, options="--no-guard --hardware.kp 600")
    kind, take = node.subscriptions["~/commands"]
    far = kind(data=(leap.joint_upper + 1.0).tolist())
    turn(15, lambda: take(far))
    assert not driver.on, "commands do not turn the motors on"
    response = node.services["~/motors"](SimpleNamespace(data=True), SimpleNamespace())
    assert response.success
    begin = len(driver.sent)
    turn(300, lambda: take(far))
    sent = np.array([targets.position for targets in driver.sent[begin:] if targets.on])
    assert np.abs(np.diff(sent, axis=0)).max() <= 7.0 * 0.03 + 1e-6 and np.abs(np.diff(sent, axis=0))[:10].max() < 0.01
    np.testing.assert_allclose(sent[-1], leap.joint_upper - 0.03, atol=1e-5)
    take(kind(data=[0.0] * 3))
    assert "3 joint targets, expected 16" in node.said
    turn(120)
    assert hand.safety.latched and not driver.on, "nobody commands any more"
    assert not node.services["~/motors"](SimpleNamespace(data=True), SimpleNamespace()).success
    driver = follower(leap)
    node, _, turn = make(driver)
    turn(20)
    for data in (True, False):
        node.services["~/motors"](SimpleNamespace(data=data), SimpleNamespace())
        turn(2)
        assert driver.on == data, "the service"


def test_a_hand_without_taxels_or_currents_publishes_what_it_has(make, leap):
    node, _, turn = make(follower(leap, ()))
    turn(3)
    assert node.topics["joint_states"][-1].effort == []
    assert node.topics["~/taxels"] == node.topics["~/wrenches/index"] == []
    assert any("no taxels" in line for line in node.said) and any("no currents" in line for line in node.said)


@pytest.mark.parametrize("way", [KeyboardInterrupt, RuntimeError])
def test_whatever_ends_the_node_turns_the_motors_off(monkeypatch, virtual_time, leap, way):
    """The command itself, with its thread."""
    driver = follower(leap)
    monkeypatch.setitem(sys.modules, "my_sdk", SimpleNamespace(open_hand=lambda hand, config: driver))
    node = Node("n", port="sdk:my_sdk", hand="leap_like", options="--no-guard")

    def spin(node):
        node.services["~/motors"](SimpleNamespace(data=True), SimpleNamespace())
        while not driver.on:
            virtual_time.sleep(0.01)
        raise way("the end")

    install(monkeypatch, node, spin)
    monkeypatch.setattr(ros, "prepare_jax", lambda: None)
    with pytest.raises(way):
        ros.main()
    assert driver.calls[-1] == "close" and not driver.sent[-1].on and node.said[-1] == "destroyed"
