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
from dexsim.core.config import to_dict
from dexsim.core.errors import CheckpointError, ConfigError
from dexsim.core.files import write_whole
from dexsim.core.install import install_line
from dexsim.hand.source import check_record
from dexsim.task_spec import TaskSpec
from dexsim_ppo.learner.memory import GRU, state_size
from dexsim_ppo.learner.types import Field
from dexsim_ppo.policy import Policy, layout_to_list, load_policy
from dexsim_ppo.policy_file import memory_to_list
from dexsim_ppo.portable import FORMAT, UNIT, PortablePolicy, check_header
from dexsim_ppo.retired import read_spec

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
    function: Callable[[np.ndarray | None, np.ndarray], tuple[np.ndarray | None, np.ndarray]]
    """From carry and observation to carry and action."""
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
        "memory": memory_to_list(policy.params.memory),
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
    arrays |= dict(zip(UNIT, jax.tree.leaves(policy.params.memory), strict=False))
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **{name: np.asarray(array) for name, array in arrays.items()})
    write_whole(path, [buffer.getvalue()])


def to_onnx(policy: Policy, path: Path) -> None:
    """Write an ONNX model: input `observation` [batch, n], output `action` [batch, A], float32. One with a memory also
    has `carry` [batch, m], zero at an episode's start, and gives `next_carry`.

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
        helper.make_node("Clip", ["scaled", "low", "high"], ["seen" if params.memory else "hidden_0"]),
    ]
    remembered = state_size(params.memory, len(params.normalizer.mean))
    if isinstance(params.memory, GRU):
        values |= _gru_weights(params.memory)
        nodes += [
            helper.make_node("Unsqueeze", ["seen", "time"], ["seen_at_once"]),
            helper.make_node("Unsqueeze", ["carry", "time"], ["before"]),
            helper.make_node(
                "GRU",
                ["seen_at_once", "gru_input", "gru_recurrent", "gru_bias", "", "before"],
                ["", "after"],
                hidden_size=remembered,
                linear_before_reset=1,
            ),
            helper.make_node("Squeeze", ["after", "time"], ["next_carry"]),
            helper.make_node("Concat", ["seen", "next_carry"], ["hidden_0"], axis=1),
        ]
    elif params.memory is not None:
        values |= {"begin": np.array([0]), "end": np.array([remembered]), "axis": np.array([1])}
        nodes += [
            helper.make_node("Concat", ["seen", "carry"], ["hidden_0"], axis=1),
            helper.make_node("Slice", ["hidden_0", "begin", "end", "axis"], ["next_carry"]),
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
    sizes = {"observation": len(params.normalizer.mean), "action": params.layers[-1].kernel.shape[1]}
    if remembered:
        sizes |= {"carry": remembered, "next_carry": remembered}
    ports = {
        name: helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", size]) for name, size in sizes.items()
    }
    given = [ports.pop(name) for name in ("observation", "carry") if name in ports]
    arrays = {name: np.asarray(value) for name, value in values.items()}
    tensors = [
        numpy_helper.from_array(array if array.dtype.kind == "i" else array.astype(np.float32), name)
        for name, array in arrays.items()
    ]
    graph = helper.make_graph(nodes, policy.task, given, list(ports.values()), tensors)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", _OPSET)], ir_version=8)
    helper.set_model_props(model, {_KEY: json.dumps(header_of(policy))})
    checker.check_model(model)
    write_whole(path, [model.SerializeToString()])


def _gru_weights(unit: GRU) -> dict[str, np.ndarray]:
    """Weights as ONNX orders them: update gate first, one row a unit, and a leading axis for the direction."""

    def ordered(array: Any) -> np.ndarray:
        reset, update, new = np.split(np.asarray(array), 3, -1)
        return np.concatenate([update, reset, new], -1).T[None]

    return {
        "time": np.array([0]),
        "gru_input": ordered(unit.input.kernel),
        "gru_recurrent": ordered(unit.recurrent.kernel),
        "gru_bias": np.concatenate([ordered(unit.input.bias), ordered(unit.recurrent.bias)], -1),
    }


def load_exported(path: str | Path) -> ExportedPolicy:
    """Read an exported policy, `.npz` or `.onnx`.

    Raises:
      CheckpointError: it is unsound, or onnxruntime is not installed.
    """
    path = Path(path)
    header, function = _read_onnx(path) if path.suffix == ".onnx" else _read_numpy(path)
    try:
        check_header(header)
        if header.get("hand") is not None:
            check_record(header["hand"])
        policy = ExportedPolicy(
            task=str(header["task"]),
            observation_layout=tuple(Field(*field) for field in header["observation_layout"]),
            control_rate=float(header["control_rate"]),
            spec=read_spec(header["spec"], path) if header.get("spec") else None,
            params=np.frombuffer(path.read_bytes(), np.uint8),
            function=function,
            carry_size=_carry_size(header),
            hand=header.get("hand"),
        )
        _try(policy)
    except Exception as error:  # onnxruntime's own error types differ by version
        raise CheckpointError(f"{path}: is not a sound policy ({' '.join(str(error).split()):.200})") from None
    return policy


def _try(policy: ExportedPolicy) -> None:
    """Raises what a tick raises; ValueError: it gives what is no action, or another carry than it takes.

    A network of ONNX may be any: what it takes and gives is not said by the header.
    """
    carry = policy.initial_carry()
    after, action = policy.act(carry, np.zeros(sum(field.size for field in policy.observation_layout), np.float32))
    kept = getattr(after, "shape", None) == getattr(carry, "shape", None)
    if action.ndim != 1 or not np.isfinite(action).all() or not kept:
        raise ValueError("it gives actions that are not finite, or another carry than it takes")


def _carry_size(header: dict[str, Any]) -> int:
    kind, size = header.get("memory") or ("none", 0)
    return size * sum(n for _, n, _ in header["observation_layout"]) if kind == "history" else size


def _read_numpy(path: Path) -> tuple[dict[str, Any], Callable]:
    try:
        policy = PortablePolicy.load(path)
    except (OSError, ValueError) as error:
        # Other errors than of the system name the file themselves.
        where = f"{path}: {error.strerror or error}" if isinstance(error, OSError) else str(error)
        raise CheckpointError(where) from None
    return policy.header, policy.act


def _read_onnx(path: Path) -> tuple[dict[str, Any], Callable]:
    try:
        import onnxruntime
    except ImportError:
        raise CheckpointError(f"{path}: running ONNX needs onnxruntime: {install_line('onnx')}") from None
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1  # waking threads costs more than this small network
    try:
        # From memory, so that it takes no weights from other files.
        session = onnxruntime.InferenceSession(path.read_bytes(), options, providers=["CPUExecutionProvider"])
        header = json.loads(session.get_modelmeta().custom_metadata_map[_KEY])
    except OSError as error:
        raise CheckpointError(f"{path}: {error.strerror or error}") from None
    except Exception as error:  # onnxruntime's own error types differ by version
        raise CheckpointError(f"{path}: is not an exported policy ({' '.join(str(error).split()):.200})") from None

    def act(carry: np.ndarray | None, observation: np.ndarray) -> tuple[np.ndarray | None, np.ndarray]:
        batch = observation.shape[:-1]
        given = {"observation": observation.reshape(-1, observation.shape[-1])}
        if carry is None:
            return None, session.run(["action"], given)[0].reshape(*batch, -1)
        given["carry"] = carry.reshape(-1, carry.shape[-1])
        carry, action = session.run(["next_carry", "action"], given)
        return carry.reshape(*batch, -1), action.reshape(*batch, -1)

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
    cli.check_writable(arguments.output)
    policy = load_policy(arguments.policy)
    writers[arguments.output.suffix](policy, arguments.output)
    sizes = ", ".join(f"{field.name} {field.size}" for field in policy.observation_layout)
    print(f"{arguments.output}: {policy.task}, {policy.control_rate:g} Hz; observation: {sizes}")
    return 0


if __name__ == "__main__":
    cli.run(main)
