"""Writes a policy for programs without JAX.

    python -m dexsim_ppo.export grasp --output grasp.npz     # NumPy alone (`dexsim_ppo.portable`)
    python -m dexsim_ppo.export grasp --output grasp.onnx    # any ONNX runtime (extra `onnx`)

Both hold the observation's normalisation, so they take observations in SI units, and what a host must know of the task:
`python -m dexsim_real.run` takes either in place of a policy file.
"""

import io
import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import jax
import numpy as np
import tyro

from dexsim.core import cli
from dexsim.core.config import from_dict, to_dict
from dexsim.core.errors import CheckpointError, ConfigError
from dexsim.core.files import write_whole
from dexsim.core.install import require
from dexsim.core.layout import LayoutEntry, layout_size
from dexsim.task_spec import TaskSpec
from dexsim_ppo.policy import Policy, PolicyHeader, load_policy
from dexsim_ppo.portable import FORMAT, PortablePolicy

_OPSET = 17
_KEY = "dexsim"  # of the header among the model's properties
_GRU = ("input_kernel", "input_bias", "recurrent_kernel", "recurrent_bias")

Function = Callable[[np.ndarray | None, np.ndarray], tuple[np.ndarray | None, np.ndarray]]
"""From carry and observation to carry and action."""


@dataclass(frozen=True, kw_only=True)
class ExportedPolicy:
    """An exported policy as the bridge uses it: what of `Policy` it needs."""

    task: str
    observation_layout: tuple[LayoutEntry, ...]
    control_rate: float
    spec: TaskSpec | None
    params: np.ndarray
    """The file's bytes, of which the bridge takes a hash."""
    function: Function
    carry_size: int = 0
    """Length m of its carry; 0 if it has no memory."""
    hand: dict[str, Any] | None = None
    """As of `Policy`."""

    def initial_carry(self, *batch: int) -> np.ndarray | None:
        """As of `Policy`."""
        return np.zeros((*batch, self.carry_size), np.float32) if self.carry_size else None

    def act(self, carry: Any, obs: Any) -> tuple[np.ndarray | None, np.ndarray]:
        """As of `Policy`."""
        return self.function(carry, np.asarray(obs, np.float32))


# --- write ----------------------------------------------------------------------------------------------


def contents(policy: Policy) -> tuple[str, dict[str, np.ndarray]]:
    """The header, JSON, and the arrays by name, of either format; see `dexsim_ppo.portable`."""
    header = {"format": FORMAT, "task": policy.task} | cli.plain(to_dict(policy.header))
    params = policy.params
    arrays = {"mean": params.normalizer.mean, "std": params.normalizer.std}
    for i, layer in enumerate(params.layers):
        arrays |= {f"kernel_{i}": layer.kernel, f"bias_{i}": layer.bias}
    if params.memory:
        arrays |= dict(zip(_GRU, jax.tree.leaves(params.memory), strict=True))
    return json.dumps(header), {name: np.asarray(array) for name, array in arrays.items()}


def to_numpy(policy: Policy, path: Path) -> None:
    """Write a file for `PortablePolicy`."""
    (header, arrays), buffer = contents(policy), io.BytesIO()
    np.savez(buffer, allow_pickle=False, header=np.array(header), **arrays)
    write_whole(path, [buffer.getvalue()])


def to_onnx(policy: Policy, path: Path) -> None:
    """Write an ONNX model: input `observation` [batch, n], output `action` [batch, A], float32. One with a memory also
    has `carry` [batch, m], zero at an episode's start, and gives `next_carry`.

    Raises:
      DexsimError: onnx is not installed.
    """
    require("onnx", "onnx", f"writing {path}")
    from onnx import TensorProto, checker, helper, numpy_helper

    header, arrays = contents(policy)
    clip, units = np.float32(policy.params.normalizer.clip), policy.params.memory and len(arrays["recurrent_kernel"])
    values: dict[str, Any] = arrays | {"low": -clip, "high": clip, "lowest": np.float32(-1), "highest": np.float32(1)}
    node = helper.make_node
    nodes = [
        node("Sub", ["observation", "mean"], ["centred"]),
        node("Div", ["centred", "std"], ["scaled"]),
        node("Clip", ["scaled", "low", "high"], ["normalized" if units else "hidden_0"]),
    ]
    if units:
        values = {name: value for name, value in values.items() if name not in _GRU} | _onnx_gru(arrays)
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
    if policy.params.squash == "tanh":
        nodes.append(node("Tanh", [f"sum_{last}"], ["action"]))
    else:
        nodes.append(node("Clip", [f"sum_{last}", "lowest", "highest"], ["action"]))
    port = lambda name, size: helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", size])  # noqa: E731
    inputs, outputs = [port("observation", len(arrays["mean"]))], [port("action", len(arrays[f"bias_{last}"]))]
    if units:
        inputs, outputs = [*inputs, port("carry", units)], [*outputs, port("next_carry", units)]
    tensors = [numpy_helper.from_array(np.asarray(value), name) for name, value in values.items()]
    graph = helper.make_graph(nodes, policy.task, inputs, outputs, tensors)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", _OPSET)], ir_version=8)
    helper.set_model_props(model, {_KEY: header})
    checker.check_model(model)
    write_whole(path, [model.SerializeToString()])


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


# --- read -----------------------------------------------------------------------------------------------


def load_exported(path: str | Path) -> ExportedPolicy:
    """Read an exported policy, `.npz` or `.onnx`.

    Raises:
      CheckpointError: it is unsound.
      DexsimError: onnxruntime is not installed.
    """
    path = Path(path)
    if path.suffix == ".onnx":
        require("onnxruntime", "onnx", f"running {path}")
    try:
        data, function = _read_onnx(path) if path.suffix == ".onnx" else _read_numpy(path)
        task = data.pop("task")
        header = from_dict(PolicyHeader, {name: value for name, value in data.items() if name != "format"})
        policy = ExportedPolicy(
            task=task,
            observation_layout=header.layout,
            control_rate=header.control_rate,
            spec=header.spec,
            params=np.frombuffer(path.read_bytes(), np.uint8),
            function=function,
            carry_size=header.memory[1] if header.memory else 0,
            hand=header.hand,
        )
        _, action = policy.act(policy.initial_carry(), np.zeros(layout_size(header.layout), np.float32))
    except OSError as error:
        raise CheckpointError(f"{path}: {error.strerror or error}") from None
    except Exception as error:  # onnxruntime's and zipfile's own error types differ by version
        raise CheckpointError(f"{path}: invalid exported policy ({' '.join(str(error).split()):.200})") from None
    if not np.isfinite(action).all():  # The network moves motors: numbers of an export have no checksum.
        raise CheckpointError(f"{path}: gives actions that are not finite")
    return policy


def _read_numpy(path: Path) -> tuple[dict[str, Any], Function]:
    policy = PortablePolicy.load(path)
    return dict(policy.header), policy.act


def _read_onnx(path: Path) -> tuple[dict[str, Any], Function]:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1  # waking threads costs more than this small network
    # From memory, so that it takes no weights from other files.
    session = onnxruntime.InferenceSession(path.read_bytes(), options, providers=["CPUExecutionProvider"])

    def act(carry: np.ndarray | None, observation: np.ndarray) -> tuple[np.ndarray | None, np.ndarray]:
        batch = observation.shape[:-1]
        inputs = {"observation": observation.reshape(-1, observation.shape[-1])}
        if carry is None:
            return None, session.run(["action"], inputs)[0].reshape(*batch, -1)
        inputs["carry"] = carry.reshape(-1, carry.shape[-1])
        carry, action = session.run(["next_carry", "action"], inputs)
        return carry.reshape(*batch, -1), action.reshape(*batch, -1)

    return json.loads(session.get_modelmeta().custom_metadata_map[_KEY]), act


@dataclass(frozen=True, kw_only=True)
class ExportArguments:
    """Options of `python -m dexsim_ppo.export`."""

    policy: Annotated[str, tyro.conf.Positional]
    """A policy file, or the name of a shipped policy, such as grasp."""
    output: Path
    """File to write: .npz for NumPy alone, .onnx for ONNX."""


def main(argv: Sequence[str] | None = None) -> int:
    """The command. Returns its exit code, 0."""
    arguments = cli.parse(
        ExportArguments,
        sys.argv[1:] if argv is None else argv,
        prog="python -m dexsim_ppo.export",
        description="Write a policy for programs without JAX.",
    )
    writers = {".npz": to_numpy, ".onnx": to_onnx}
    if arguments.output.suffix not in writers:
        raise ConfigError(f"--output {arguments.output}: give a file that ends in {' or '.join(writers)}")
    cli.check_writable(arguments.output)
    policy = load_policy(arguments.policy)
    writers[arguments.output.suffix](policy, arguments.output)
    sizes = ", ".join(f"{entry.name} {entry.size}" for entry in policy.observation_layout)
    print(f"{arguments.output}: {policy.task}, {policy.control_rate:g} Hz; observation: {sizes}")
    return 0


if __name__ == "__main__":
    cli.run(main)
