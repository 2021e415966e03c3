"""A ROS 2 node of the hand: one more user of the exchange loop, with the same safety as a policy's run.

    python -m dexsim_real.ros --ros-args -p port:=/dev/ttyUSB0 -p calibration:=hand.toml

| topic or service | type | content |
|---|---|---|
| `joint_states` | sensor_msgs/JointState | rad, rad/s, Nm (no effort without currents) |
| `~/wrenches/FINGER` | geometry_msgs/WrenchStamped | N, Nm on the fingertip by its taxels, in the frame of its body |
| `~/taxels` | std_msgs/Float32MultiArray | N, fingers x taxels, in the order of the hand's TOML |
| `~/commands` | std_msgs/Float64MultiArray | joint targets [J] rad, as for `forward_command_controller` |
| `~/motors` | std_srvs/SetBool | motors on at the measured pose; off for good |

Commands are a stream: without one for `--safety.watchdog` the hand holds, then its motors go off. The parameter
`options` has further options of `NodeArguments` as on a command line. rclpy is imported when the node runs.
"""

import dataclasses
import shlex
from pathlib import Path
from typing import Any

import numpy as np

from dexsim import load_hand
from dexsim.calibration.maps import load_calibration
from dexsim.core import cli
from dexsim.core.config import setting
from dexsim_real.control.controller import prepare_jax
from dexsim_real.control.guard import Guard
from dexsim_real.control.limits import SafetyConfig
from dexsim_real.control.safety import Safety
from dexsim_real.loop import LoopConfig, LoopThread
from dexsim_real.sensors.hand import HandSensing
from dexsim_real.wire.driver import open_port


@dataclasses.dataclass(frozen=True, kw_only=True)
class NodeArguments(LoopConfig):
    """Options in the parameter `options`."""

    guard: bool = True
    """Start a second process that turns the motors off when this one dies or freezes."""
    safety: SafetyConfig = setting(SafetyConfig(watchdog=0.2))
    """Safety limits."""


class HandNode:
    """The hand behind a `rclpy` node. `start` connects it with the motors off.

    Raises DexsimError: hand, calibration or port do not fit together.
    """

    def __init__(self, node: Any):
        from geometry_msgs.msg import WrenchStamped
        from sensor_msgs.msg import JointState
        from std_msgs.msg import Float32MultiArray, Float64MultiArray, MultiArrayDimension
        from std_srvs.srv import SetBool

        self.node, self._joint_state, self._wrench = node, JointState, WrenchStamped
        given = {name: node.declare_parameter(name, "").value for name in ("port", "hand", "calibration")}
        words = shlex.split(node.declare_parameter("options", "").value)
        self.options = options = cli.parse(NodeArguments, words, prog="options", description="Options of the node.")
        self.hand = hand = load_hand(given["hand"] or None)
        calibration = load_calibration(Path(given["calibration"]), hand) if given["calibration"] else None
        self.sensing = HandSensing(hand, options.hardware, calibration)
        self.port = open_port(given["port"], hand, options.link)
        self.safety = Safety(hand, options.safety, node.get_logger().info)
        guard = Guard(given["port"], options.link, hand) if options.guard else None
        self.loop = LoopThread(self.port, self.sensing, self.safety, options.rate, guard)
        self._shown = -1  # sequence number of the newest message
        node.create_subscription(Float64MultiArray, "~/commands", self.take_command, 1)
        self._joints = node.create_publisher(JointState, "joint_states", 10)
        self._wrenches = [node.create_publisher(WrenchStamped, f"~/wrenches/{f}", 10) for f in hand.finger_names]
        self._taxels = node.create_publisher(Float32MultiArray, "~/taxels", 10)
        self._array = Float32MultiArray()
        fingers, taxels = hand.num_fingers, hand.num_taxels
        for label, size, stride in (("finger", fingers, fingers * taxels), ("taxel", taxels, taxels)):
            self._array.layout.dim.append(MultiArrayDimension(label=label, size=size, stride=stride))
        node.create_service(SetBool, "~/motors", self.switch)
        node.create_timer(1 / options.rate, self.publish)

    def start(self) -> None:
        """Connect with the motors off, tare the taxels, and start the exchange loop.

        Raises HandError: the hand does not answer, is another one, or something touches a fingertip.
        """
        log = self.node.get_logger().info
        for line in (*self.port.greet(self.hand, self.sensing.calibration), *self.loop.tare()):
            log(line)
        self.loop.start()

    def switch(self, request: Any, response: Any) -> Any:
        """The service: motors on, or off for good."""
        if request.data:
            self.loop.engage()
        else:
            self.safety.relax("switched off by ~/motors")
        response.success = not (request.data and self.safety.latched)
        response.message = self.safety.latched
        return response

    def take_command(self, message: Any) -> None:
        """Joint targets [J] rad; `Safety` limits them."""
        if len(message.data) != self.hand.num_joints:
            self.node.get_logger().error(f"{len(message.data)} joint targets, expected {self.hand.num_joints}")
            return
        self.safety.set_target(np.asarray(message.data, np.float32), self.loop.clock())

    def publish(self) -> None:
        """Publish the newest measurement, once. HandError: the exchange loop has failed."""
        self.loop.check()
        sample = self.safety.sample
        if sample is None or sample.sequence == self._shown:
            return
        self._shown = sample.sequence
        stamp, measured, hand = self.node.get_clock().now().to_msg(), sample.measured, self.hand
        joints = self._joint_state(name=list(hand.joint_names))
        joints.header.stamp = stamp
        joints.position, joints.velocity = measured.joint_position.tolist(), sample.velocity.tolist()
        if "currents" not in self.port.missing:
            joints.effort = (measured.joint_torque * hand.torque_limit).tolist()
        self._joints.publish(joints)
        if "taxels" in self.port.missing:
            return
        pressed = -measured.taxel_force[..., None] * hand.taxel_normal  # along the inward normals
        # Force N and torque Nm [F, 2, 3] on each fingertip about the origin of its body.
        wrenches = np.stack([pressed, np.cross(hand.taxel_position, pressed)], 1).sum(2).astype(float)
        for publisher, body, parts in zip(self._wrenches, hand.tip_body, wrenches, strict=True):
            wrench = self._wrench()
            wrench.header.stamp, wrench.header.frame_id = stamp, hand.body_names[body]
            for vector, values in zip((wrench.wrench.force, wrench.wrench.torque), parts, strict=True):
                vector.x, vector.y, vector.z = values.tolist()
            publisher.publish(wrench)
        self._array.data = measured.taxel_force.ravel().tolist()
        self._taxels.publish(self._array)


def main(argv: Any = None) -> int:
    import rclpy

    prepare_jax()
    rclpy.init()
    node = rclpy.create_node("dexsim_hand")
    hand = HandNode(node)
    try:
        hand.start()
        rclpy.spin(node)
    finally:
        hand.loop.stop()  # The motors go off.
        node.destroy_node()
        rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    cli.run(main)
