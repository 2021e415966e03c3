"""Stands in for rclpy and the message packages, as far as `dexsim_real.ros` uses them: a node that keeps its messages.

Messages have the fields of the ROS definitions, and take no others.
"""

import dataclasses
import sys
import types
from types import SimpleNamespace


def message(name, /, **fields):
    """A class of messages: fields with the makers of their first values; unknown ones are an error, as in ROS."""
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
