"""Writes a policy as an ONNX model (extra `onnx`), which takes observations in SI units, alone or in a bundle: a folder
or zip file with all that a robot's computer needs to run it, which is neither JAX nor this library.

    python -m dexsim_ppo.export grasp --output grasp.onnx
    python -m dexsim_ppo.export grasp --bundle grasp.zip

`dexsim_ppo.portable` runs a policy's own file without JAX.
"""

import dataclasses
import hashlib
import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from string import Template
from typing import Annotated, Any

import numpy as np
import tyro

from dexsim.calibration.maps import blank_calibration, save_calibration
from dexsim.core import cli
from dexsim.core.assets import asset_path
from dexsim.core.files import temporary_beside, write_atomic
from dexsim.core.install import require
from dexsim.errors import ConfigError, DexsimError
from dexsim.hand.description import Hand
from dexsim.hand.load import load_hand
from dexsim.observation import FIELDS
from dexsim_ppo.policy import Policy, load_policy


def to_onnx(policy: Policy, path: Path) -> None:
    """Write an ONNX model: input `observation` [batch, n], output `action` [batch, A], float32. One with a memory also
    has `carry` [batch, m], zero at an episode's start, and gives `next_carry`.

    Raises:
      DexsimError: onnx is not installed.
    """
    require("onnx", "onnx", f"writing {path}")
    from onnx import TensorProto, checker, helper, numpy_helper

    arrays, clip = policy.arrays(), np.float32(policy.params.normalizer.clip)
    units = len(arrays["recurrent_kernel"]) if policy.params.memory is not None else 0
    values: dict[str, Any] = arrays | {"low": -clip, "high": clip, "lowest": np.float32(-1), "highest": np.float32(1)}
    node = helper.make_node
    nodes = [
        node("Sub", ["observation", "mean"], ["centred"]),
        node("Div", ["centred", "std"], ["scaled"]),
        node("Clip", ["scaled", "low", "high"], ["normalized" if units else "hidden_0"]),
    ]
    if units:
        values = {name: x for name, x in values.items() if not name.startswith(("input_", "recurrent_"))}
        values |= _onnx_gru(arrays)
        nodes += [
            node("Unsqueeze", ["normalized", "time"], ["sequence"]),
            node("Unsqueeze", ["carry", "time"], ["before"]),
            node(
                "GRU",
                ["sequence", "gru_input", "gru_recurrent", "gru_bias", "", "before"],
                ["", "after"],
                hidden_size=units,
                linear_before_reset=1,
            ),
            node("Squeeze", ["after", "time"], ["next_carry"]),
            node("Concat", ["normalized", "next_carry"], ["hidden_0"], axis=1),
        ]
    last = len(policy.params.layers) - 1
    for i in range(last + 1):
        nodes += [
            node("MatMul", [f"hidden_{i}", f"kernel_{i}"], [f"product_{i}"]),
            node("Add", [f"product_{i}", f"bias_{i}"], [f"sum_{i}"]),
        ]
        if i < last:
            nodes.append(node("Elu", [f"sum_{i}"], [f"hidden_{i + 1}"]))
    nodes.append(node("Clip", [f"sum_{last}", "lowest", "highest"], ["action"]))
    port = lambda name, size: helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", size])  # noqa: E731
    inputs, outputs = [port("observation", len(arrays["mean"]))], [port("action", len(arrays[f"bias_{last}"]))]
    if units:
        inputs, outputs = [*inputs, port("carry", units)], [*outputs, port("next_carry", units)]
    tensors = [numpy_helper.from_array(np.asarray(value), name) for name, value in values.items()]
    graph = helper.make_graph(nodes, policy.task, inputs, outputs, tensors)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    header = json.dumps({"task": policy.task} | cli.plain(policy.header()))
    helper.set_model_props(model, {"dexsim": header})
    checker.check_model(model)
    write_atomic(path, [model.SerializeToString()])


def _onnx_gru(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Weights as ONNX orders them: update gate first, one row a unit, and a leading axis for the direction."""

    def ordered(name: str) -> np.ndarray:
        reset, update, new = np.split(arrays[name], 3, -1)
        return np.concatenate([update, reset, new], -1).T[None]

    return {
        "time": np.array([0]),
        "gru_input": ordered("input_kernel"),
        "gru_recurrent": ordered("recurrent_kernel"),
        "gru_bias": np.concatenate([ordered("input_bias"), ordered("recurrent_bias")], -1),
    }


_UNITS = {
    "joint_position": "rad",
    "joint_torque": "torque over the joint's torque limit, from calibrated current",
    "object_position": "m",
    "object_velocity": "m/s",
    "contact_force": "N, sum of a finger's taxels",
    "contact_centre": "m, mean position of a finger's taxels weighted by force; 0 without contact",
    "finger_force": "N, from taxels and torque",
    "fingertip_position": "m, by forward kinematics",
    "fingertip_rotation": "first two columns of the rotation matrix",
    "command": "grip command, 0 to 1",
    "last_action": "the action before this observation; or the joint targets, -1 to 1 over their ranges",
    "past_actions": "the two actions before the last, newest first",
    "palm_gravity": "unit vector",
    "relative_orientation": "rotation from object to goal, first two columns or (w, x, y, z)",
    "object_orientation": "first two columns of the rotation matrix or (w, x, y, z)",
}


def write_bundle(policy: Policy, path: Path) -> None:
    """Write a folder, or a file where `path` ends in .zip, whole or not at all: the ONNX model, its configuration, a
    template of the calibration, a card with the code that runs it, and the digests of these.

    Raises:
      ConfigError: the policy is of an environment without a hand.
      DexsimError: onnx is not installed, or there is something at `path`.
    """
    if policy.spec is None:
        raise ConfigError(f"--bundle {path}: the policy of {policy.task!r} is of no task on a hand; use --output")
    if path.exists():
        raise DexsimError(f"{path}: exists already; name another folder or file")
    hand = policy.find_hand() or load_hand()
    part = temporary_beside(path)
    part.mkdir(parents=True)
    try:
        to_onnx(policy, part / "policy.onnx")
        cli.write_json(part / "config.json", bundle_config(policy, hand))
        save_calibration(part / "calibration.toml", blank_calibration(hand))
        (part / "README.md").write_text(_card(policy, hand))
        sums = [f"{hashlib.sha256(file.read_bytes()).hexdigest()}  {file.name}\n" for file in sorted(part.iterdir())]
        (part / "SHA256SUMS").write_text("".join(sums))
        if path.suffix == ".zip":
            Path(shutil.make_archive(str(part), "zip", part)).rename(path)
        else:
            part.rename(path)
    finally:
        shutil.rmtree(part, ignore_errors=True)


def bundle_config(policy: Policy, hand: Hand) -> dict[str, Any]:
    """What a program on the robot reads: rate, fields of the observation, joints, and how an action moves them."""
    assert policy.spec is not None, "a task on a hand"
    limits = zip(hand.joint_names, hand.joint_lower, hand.joint_upper, hand.torque_limit, strict=True)
    return {
        "task": policy.task,
        "hand": hand.name,
        "control_rate": policy.control_rate,
        "observation": [
            {
                "name": entry.name,
                "size": entry.size,
                "unit": _UNITS.get(entry.name, "SI"),
                "source": FIELDS[entry.name].source,
            }
            for entry in policy.observation_layout
        ],
        "joints": [
            {"name": name, "lower": low, "upper": high, "torque_limit": torque} for name, low, high, torque in limits
        ],
        "step": policy.spec.control.step,
        "reach": policy.spec.control.reach,
        "spec": dataclasses.asdict(policy.spec),
        "training": policy.training,
    }


def _card(policy: Policy, hand: Hand) -> str:
    config = bundle_config(policy, hand)
    rows = [f"| `{x['name']}` | {x['size']} | {x['unit']} | {x['source']} |" for x in config["observation"]]
    origin = {name: value for name, value in policy.training.items() if isinstance(value, (int, float, str))}
    return Template(asset_path("bundle/README.md").read_text()).substitute(
        task=policy.task,
        hand=hand.name,
        rate=f"{policy.control_rate:g}",
        size=sum(x["size"] for x in config["observation"]),
        rows="\n".join(rows),
        training=", ".join(f"{name} {value}" for name, value in origin.items()) or "see `config.json`",
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class ExportArguments:
    """Write a policy as an ONNX model, or as a bundle for a robot's computer."""

    policy: Annotated[str, tyro.conf.Positional]
    """A policy file, or the name of a shipped policy, such as grasp."""
    output: Path | None = None
    """File of the model; None writes none."""
    bundle: Path | None = None
    """Folder, or file that ends in .zip, of the bundle, which must not exist yet; None writes none."""


def main(argv: Sequence[str] | None = None) -> int:
    """The command. Returns its exit code, 0."""
    arguments = cli.parse(ExportArguments, argv)
    if arguments.output is None and arguments.bundle is None:
        raise ConfigError("give --output FILE or --bundle FOLDER_OR_ZIP")
    policy = load_policy(arguments.policy)
    cli.check_no_overwrite({"--output": arguments.output}, {"policy": arguments.policy})
    if arguments.output:
        cli.check_writable(arguments.output)
        to_onnx(policy, arguments.output)
    if arguments.bundle:
        write_bundle(policy, arguments.bundle)
    sizes = ", ".join(f"{entry.name} {entry.size}" for entry in policy.observation_layout)
    written = ", ".join(str(path) for path in (arguments.output, arguments.bundle) if path)
    print(f"{written}: {policy.task}, {policy.control_rate:g} Hz; observation: {sizes}")
    return 0


if __name__ == "__main__":
    cli.run(main)
