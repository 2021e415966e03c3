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

import numpy as np
import tyro

from dexsim.core import cli
from dexsim.core.config import from_dict, to_dict
from dexsim.core.errors import CheckpointError, ConfigError
from dexsim.core.files import write_whole
from dexsim.core.install import install_line
from dexsim.task_spec import TaskSpec
from dexsim_ppo.learner.types import Field
from dexsim_ppo.policy import Policy, layout_to_list, load_policy
from dexsim_ppo.portable import FORMAT, PortablePolicy

_OPSET = 17
_KEY = "dexsim"  # of the header among the model's properties


@dataclass(frozen=True, kw_only=True)
class ExportedPolicy:
    """An exported policy as the bridge uses it: what of `Policy` it needs."""

    task: str
    observation_layout: tuple[Field, ...]
    control_rate: float
    spec: TaskSpec | None
    params: Any
    """Whatever tells it from others: bytes."""
    function: Callable[[np.ndarray], np.ndarray]
    hand: dict[str, Any] | None = None
    """As of `Policy`."""

    def __call__(self, obs: Any) -> np.ndarray:
        """Action `[..., A]` for an actor observation `[..., n]`."""
        return self.function(np.asarray(obs, np.float32))


def header_of(policy: Policy) -> dict[str, Any]:
    """What an exported file says beside its numbers; plain JSON."""
    return {
        "format": FORMAT,
        "task": policy.task,
        "control_rate": policy.control_rate,
        "observation_layout": layout_to_list(policy.observation_layout),
        "squash": policy.params.squash,
        "clip": policy.params.normalizer.clip,
        "layers": len(policy.params.layers),
        "spec": policy.spec and to_dict(policy.spec),
        "training": cli.plain(policy.training),
        "hand": policy.hand,
    }


def to_numpy(policy: Policy, path: Path) -> None:
    """Write a file for `PortablePolicy`."""
    normalizer = policy.params.normalizer
    arrays = {"mean": normalizer.mean, "std": normalizer.std, "header": np.array(json.dumps(header_of(policy)))}
    for i, layer in enumerate(policy.params.layers):
        arrays |= {f"kernel_{i}": layer.kernel, f"bias_{i}": layer.bias}
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **{name: np.asarray(array) for name, array in arrays.items()})
    write_whole(path, [buffer.getvalue()])


def to_onnx(policy: Policy, path: Path) -> None:
    """Write an ONNX model: input `observation` [batch, n], output `action` [batch, A], float32.

    Raises:
      ConfigError: onnx is not installed.
    """
    try:
        from onnx import TensorProto, checker, helper, numpy_helper
    except ImportError:
        raise ConfigError(f"{path}: writing ONNX needs onnx: {install_line('onnx')}") from None
    params, nodes = policy.params, []
    clip = float(params.normalizer.clip)
    values = {"mean": params.normalizer.mean, "std": params.normalizer.std, "low": -clip, "high": clip}
    nodes += [
        helper.make_node("Sub", ["observation", "mean"], ["centred"]),
        helper.make_node("Div", ["centred", "std"], ["scaled"]),
        helper.make_node("Clip", ["scaled", "low", "high"], ["hidden_0"]),
    ]
    last = len(params.layers) - 1
    for i, layer in enumerate(params.layers):
        values |= {f"kernel_{i}": layer.kernel, f"bias_{i}": layer.bias}
        nodes += [
            helper.make_node("MatMul", [f"hidden_{i}", f"kernel_{i}"], [f"product_{i}"]),
            helper.make_node("Add", [f"product_{i}", f"bias_{i}"], [f"sum_{i}"]),
        ]
        if i < last:
            nodes.append(helper.make_node("Elu", [f"sum_{i}"], [f"hidden_{i + 1}"]))
    if params.squash == "tanh":
        nodes.append(helper.make_node("Tanh", [f"sum_{last}"], ["action"]))
    else:
        values |= {"lowest": -1.0, "highest": 1.0}
        nodes.append(helper.make_node("Clip", [f"sum_{last}", "lowest", "highest"], ["action"]))
    sizes = params.layers[0].kernel.shape[0], params.layers[-1].kernel.shape[1]
    ports = [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", size])
        for name, size in zip(("observation", "action"), sizes, strict=True)
    ]
    tensors = [numpy_helper.from_array(np.asarray(value, np.float32), name) for name, value in values.items()]
    graph = helper.make_graph(nodes, policy.task, ports[:1], ports[1:], tensors)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", _OPSET)], ir_version=8)
    helper.set_model_props(model, {_KEY: json.dumps(header_of(policy))})
    checker.check_model(model)
    write_whole(path, [model.SerializeToString()])


def load_exported(path: str | Path) -> ExportedPolicy:
    """Read an exported policy, `.npz` or `.onnx`.

    Raises:
      CheckpointError: it is unsound, or onnxruntime is not installed.
    """
    path = Path(path)
    header, function = _read_onnx(path) if path.suffix == ".onnx" else _read_numpy(path)
    try:
        return ExportedPolicy(
            task=str(header["task"]),
            observation_layout=tuple(Field(*field) for field in header["observation_layout"]),
            control_rate=float(header["control_rate"]),
            spec=from_dict(TaskSpec, header["spec"]) if header.get("spec") else None,
            params=np.frombuffer(path.read_bytes(), np.uint8),
            function=function,
            hand=header.get("hand"),
        )
    except (KeyError, TypeError, ValueError, ConfigError) as error:
        raise CheckpointError(f"{path}: is not a sound policy ({' '.join(str(error).split()):.200})") from None


def _read_numpy(path: Path) -> tuple[dict[str, Any], Callable]:
    try:
        policy = PortablePolicy.load(path)
    except (OSError, ValueError) as error:
        raise CheckpointError(f"{path}: {getattr(error, 'strerror', None) or error}") from None
    return policy.header, policy


def _read_onnx(path: Path) -> tuple[dict[str, Any], Callable]:
    try:
        import onnxruntime
    except ImportError:
        raise CheckpointError(f"{path}: running ONNX needs onnxruntime: {install_line('onnx')}") from None
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1  # waking threads costs more than this small network
    try:
        session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        header = json.loads(session.get_modelmeta().custom_metadata_map[_KEY])
    except Exception as error:  # onnxruntime's own error types differ by version
        raise CheckpointError(f"{path}: is not an exported policy ({' '.join(str(error).split()):.200})") from None

    def act(observation: np.ndarray) -> np.ndarray:
        rows = observation.reshape(-1, observation.shape[-1])
        (action,) = session.run(["action"], {"observation": rows})
        return action.reshape(*observation.shape[:-1], -1)

    return header, act


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
    policy = load_policy(arguments.policy)
    writers[arguments.output.suffix](policy, arguments.output)
    sizes = ", ".join(f"{field.name} {field.size}" for field in policy.observation_layout)
    print(f"{arguments.output}: {policy.task}, {policy.control_rate:g} Hz; observation: {sizes}")
    return 0


if __name__ == "__main__":
    cli.run(main)
