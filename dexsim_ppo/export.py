"""Writes a policy as an ONNX model (extra `onnx`), which takes observations in SI units.

    python -m dexsim_ppo.export grasp --output grasp.onnx

`dexsim_ppo.portable` runs a policy's own file without JAX.
"""

import dataclasses
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from dexsim.core import cli
from dexsim.core.files import write_atomic
from dexsim.core.install import require
from dexsim_ppo.policy import Policy, load_policy

_OPSET = 17
_KEY = "dexsim"  # of the header among the model's properties


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
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", _OPSET)], ir_version=8)
    header = json.dumps({"task": policy.task} | cli.plain(policy.header()))
    helper.set_model_props(model, {_KEY: header})
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


@dataclasses.dataclass(frozen=True, kw_only=True)
class ExportArguments:
    """Options of `python -m dexsim_ppo.export`."""

    policy: Annotated[str, tyro.conf.Positional]
    """A policy file, or the name of a shipped policy, such as grasp."""
    output: Path
    """File to write."""


def main(argv: Sequence[str] | None = None) -> int:
    """The command. Returns its exit code, 0."""
    arguments = cli.parse(
        ExportArguments,
        sys.argv[1:] if argv is None else argv,
        prog="python -m dexsim_ppo.export",
        description="Write a policy as an ONNX model.",
    )
    cli.check_writable(arguments.output)
    policy = load_policy(arguments.policy)
    to_onnx(policy, arguments.output)
    sizes = ", ".join(f"{entry.name} {entry.size}" for entry in policy.observation_layout)
    print(f"{arguments.output}: {policy.task}, {policy.control_rate:g} Hz; observation: {sizes}")
    return 0


if __name__ == "__main__":
    cli.run(main)
