"""`python -m dexsim_real.calibrate --identify`: moves the free joints and fits the drives' parameters to the log.

Each joint in turn follows `dexsim.identification.excitation`. Commands and answers of every exchange are passed to
`dexsim.identification.identify`. Without a calibration there are only angles, which determine the ratio of torque to
inertia; the inertia is then that of the model.
"""

import dataclasses
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from dexsim.calibration.maps import Calibration, joint_torque, load_calibration
from dexsim.core import cli
from dexsim.core.config import from_dict
from dexsim.core.errors import CalibrationError, DexsimError
from dexsim.hand.kinematics import Hand
from dexsim.identification.excitation import Excitation, excitation
from dexsim.identification.identify import FIT, identify
from dexsim.identification.joint import JointLog
from dexsim.identification.report import Identification
from dexsim_real.calibrate.bench import Workbench
from dexsim_real.calibrate.hand_loop import Operator
from dexsim_real.calibrate.options import CalibrateArguments
from dexsim_real.calibrate.taxel_check import check_answered
from dexsim_real.core.errors import HandError
from dexsim_real.core.log import Kind, LogError, LogReader, reading
from dexsim_real.core.process import stopping
from dexsim_real.sensors.hand import HardwareConfig
from dexsim_real.wire import frames
from dexsim_real.wire.identity import Identity, check_identity

TASK = "identify"
STIFFNESS, DAMPING = 3.0, 0.1  # Nm/rad, Nm s/rad: initial values of the fit
_SIGNALS: dict[str, dict[str, Any]] = {
    "fit": {},
    "hold-out": {"amplitude": 0.2, "chirp_frequency": (0.5, 2.5), "chirp_seconds": 3.0, "step_count": 3},
}
_TIMESTEP = 0.006  # s, about that of the simulation
_TARE = 0.5  # s
_LOST = 0.02  # share of the exchanges, or of the time, that may be missing
_OFF = 0.05  # share by which the time between two samples may differ from 1 / rate


@dataclasses.dataclass(frozen=True)
class _Row:
    """A logged exchange."""

    time: float  # s, when the command was sent
    command: bytes  # frame
    answer: bytes | None  # frame


@dataclasses.dataclass(frozen=True)
class _Source:
    """Whose log it is, and how it was recorded."""

    path: Path
    hardware: HardwareConfig
    rate: float
    identity: Identity


def identify_hand(arguments: CalibrateArguments, hand: Hand, operator: Operator, **bench: Any) -> list[Identification]:
    """Record or read logs, fit each joint, and write the results. A joint that fails leaves those of the others.

    Raises:
      DexsimError: the hand fails, a log cannot be used, or the data of a joint are insufficient.
    """
    for name in arguments.joints:
        if name not in hand.joint_names:
            raise HandError(f"no joint {name!r}; choose from {', '.join(hand.joint_names)}")
    calibration = load_calibration(arguments.calibration, hand) if arguments.calibration else None
    logs = arguments.from_log or (record(arguments, hand, operator, **bench),)
    results, failed = [], dict[str, DexsimError]()
    for name, (log, check) in read_logs(logs, hand, calibration, arguments.joints, failed).items():
        joint = hand.joint_names.index(name)
        start = {
            "stiffness": STIFFNESS,
            "damping": DAMPING,
            "stall_torque": float(hand.torque_limit[joint]),
            "no_load_speed": float(hand.speed_limit[joint]),
            "inertia": float(_inertia(hand)[joint]),
        }
        try:
            result = identify(
                log,
                start,
                fit=FIT,
                substeps=max(round(log.period / _TIMESTEP), 1),
                dead_band=(0.0, 0.03) if arguments.dead_band else None,
                holdout=check,
            )
        except CalibrationError as error:
            failed[name] = error
            continue
        results.append(result)
        operator.tell(result.report())
    if not results and not failed:
        raise HandError("the logs contain none of the chosen joints; check --joints and --from-log")
    if len(results) + len(failed) > 1:  # A single joint's error ends the command, which prints it.
        for reason in failed.values():
            operator.tell(f"not identified: {reason}")
    if not results:
        raise next(iter(failed.values()))
    cli.write_json(arguments.destination, {"joints": {result.joint: _plain(result) for result in results}})
    operator.tell(f"identified: {arguments.destination}")
    if failed:
        raise HandError(
            f"not identified: {', '.join(failed)} (the reasons are above); the other joints are in "
            f"{arguments.destination}"
        )
    return results


def record(arguments: CalibrateArguments, hand: Hand, operator: Operator, **bench: Any) -> Path:
    """Move the joints and record their answers; returns the log.

    Raises:
      HandError: the procedure failed, or the hand did not answer; the motors are off.
    """
    period = 1.0 / arguments.rate
    signals = {
        label: excitation(hand, Excitation(period=period, **options), _open_posture(hand), arguments.joints or None)
        for label, options in _SIGNALS.items()
    }
    seconds = sum(len(part) * period + 1.5 for signal in signals.values() for part in signal.values())
    operator.tell(f"the fingers move one after the other for {seconds / 60:.0f} minutes: keep clear of them")
    with stopping(), Workbench(arguments, hand, operator, {"task": TASK}, **bench) as work:
        try:
            loop = work.loop
            # Otherwise `Safety` would mistake the taxels' zero error for a touch.
            loop.sensing.set_tare([exchange.state for exchange in check_answered(loop.collect(_TARE), _TARE)])
            loop.step()
            if not operator.assume_yes and operator.ask("  Enter starts, s stops:", loop.step).lower() in ("s", "stop"):
                raise HandError("stopped before anything moved")
            loop.await_motors()
            for name in next(iter(signals.values())):
                operator.tell(name)
                for label, targets in signals.items():
                    loop.move(targets[name][0])
                    loop.recording = True
                    for target in targets[name]:
                        measured = loop.step(target) is not None  # An angle that cannot be true is no measurement.
                        loop.mark({"joint": name, "signal": label, "measured": measured})
                    loop.recording = False
        finally:  # A signal that comes just before this line is followed by the close of the workbench.
            work.loop.close()
    return work.log.path


def read_logs(
    paths: Iterable[Path],
    hand: Hand,
    calibration: Calibration | None,
    joints: tuple[str, ...] = (),
    failed: dict[str, DexsimError] | None = None,
) -> dict[str, tuple[JointLog, JointLog | None]]:
    """By joint, the log to fit and the held-out log to test on, None if there is none.

    Args:
      paths: logs of one hand. A joint in several of them is taken from the last.
      hand: model of the hand.
      calibration: of this hand, for torques; None leaves them unknown.
      joints: that are wanted; all by default.
      failed: gets the error of a joint whose samples cannot be used; None raises the first one.

    Raises:
      LogError: not a log of an identification, or too many exchanges are missing.
      HandError: the calibration is of another hand.
    """
    first: _Source | None = None
    recorded: dict[str, tuple[_Source, dict[str, list[_Row]]]] = {}
    for path in paths:
        with reading(path):
            source, parts = _read(Path(path), hand)
        first = first or source
        if (source.hardware, source.rate) != (first.hardware, first.rate):
            raise LogError(f"{path}: recorded with other --hardware options or another --rate than the logs before")
        if source.identity != first.identity:
            raise LogError(
                f"{path}: is of another hand ({source.identity.describe()}) than the logs before "
                f"({first.identity.describe()})"
            )
        recorded.update({name: (source, signals) for name, signals in parts.items()})
    if first and calibration is not None:
        try:
            check_identity(first.identity, hand, calibration)
        except HandError as error:
            raise HandError(f"{first.path}: {error}") from None
    results = {}
    for name, (source, signals) in recorded.items():
        if "fit" not in signals or (joints and name not in joints):
            continue
        try:
            with reading(source.path):
                logs = {
                    label: _joint_log(name, label, rows, hand, source, calibration) for label, rows in signals.items()
                }
        except LogError as error:
            if failed is None:
                raise
            failed[name] = error
            continue
        results[name] = logs["fit"], logs.get("hold-out")
    return results


def _read(path: Path, hand: Hand) -> tuple[_Source, dict[str, dict[str, list[_Row]]]]:
    """Whose log it is, and its exchanges by joint and signal."""
    source, task = None, None
    parts: dict[str, dict[str, list[_Row]]] = {}
    # The first exchange that is recorded may be unanswered, and a damaged log may lack any record.
    sent, sent_at, received = (-1, b""), 0.0, (-1, b"")
    for record in LogReader(path):
        content = record.content
        if record.kind == Kind.META and "task" in content:
            task = content["task"]
            if task == TASK:
                hardware = from_dict(HardwareConfig, content["hardware"])
                identity = Identity(content["serial"], content["handedness"])
                source = _Source(path, hardware, float(content["rate"]), identity)
        elif record.kind == Kind.SENT:
            sent, sent_at = content, record.time
        elif record.kind == Kind.RECEIVED:
            received = content
        elif record.kind == Kind.TICK and task == TASK and sent[0] == content["sequence"]:
            if content["joint"] not in hand.joint_names:
                raise LogError(f"{path}: no joint {content['joint']!r:.40}; choose from {', '.join(hand.joint_names)}")
            measured = received[0] == sent[0] and content["measured"]
            answer = received[1] if measured else None
            rows = parts.setdefault(content["joint"], {}).setdefault(content["signal"], [])
            rows.append(_Row(sent_at, sent[1], answer))
    if source is None or task != TASK:
        reason = f"it is a log of {task!r}" if task else "it ends before the hand was ready"
        raise LogError(f"{path}: this is not a log of --identify: {reason}")
    return source, parts


def _joint_log(
    name: str, signal: str, rows: list[_Row], hand: Hand, source: _Source, calibration: Calibration | None
) -> JointLog:
    """The samples of a joint in one signal."""
    joint, where = hand.joint_names.index(name), f"{source.path}: {signal} of {name}"
    sign, offset = source.hardware.joint_sign[joint], source.hardware.joint_offset[joint]
    lost = np.array([row.answer is None for row in rows])
    if np.mean(lost) > _LOST:
        raise LogError(
            f"{where}: {np.sum(lost)} of {len(lost)} exchanges are missing; check the cable and record again"
        )
    _check_times(np.array([row.time for row in rows]), 1.0 / source.rate, where)
    answers = [row.answer for row in rows if row.answer is not None]
    state = np.array([frames.decode_state(frame[frames.HEADER.size : -2])["joint"] for frame in answers])
    command = np.array([frames.decode_command(row.command[frames.HEADER.size : -2])["position"] for row in rows])
    target, position = (part[:, joint].astype(float) * sign + offset for part in (command, state["position"]))
    # Few samples are missing: interpolate them.
    time = np.arange(len(rows))
    position = np.interp(time, time[~lost], position)
    torque = None
    if calibration is not None:
        current = state["current"].astype(float) * calibration.current_per_count
        torque = np.array(joint_torque(calibration, current))[:, joint]
        torque = np.interp(time, time[~lost], torque)
    return JointLog(1.0 / source.rate, target, position, torque, name)


def _check_times(time: np.ndarray, period: float, where: str) -> None:
    """Check that samples at these times [T] s are a period in s apart: the fit takes that for granted.

    Raises:
      LogError: the exchanges took longer, or a stretch is missing.
    """
    if len(time) < 2:
        return  # Too short for any fit, which says so.
    step, missing = np.median(np.diff(time)), time[-1] - time[0] - (len(time) - 1) * period
    if not abs(step - period) <= _OFF * period:
        raise LogError(
            f"{where}: an exchange took {1e3 * step:.1f} ms, {1e3 * period:.1f} ms were expected; set the latency "
            "timer of the adapter to 1 ms, or record again with a lower --rate"
        )
    if not missing <= _LOST * len(time) * period:
        raise LogError(
            f"{where}: {1e3 * missing:.0f} ms of {1e3 * len(time) * period:.0f} ms are missing between the samples: "
            "cycles were skipped or the log is damaged; record again"
        )


def _open_posture(hand: Hand) -> np.ndarray:
    """A posture [J] rad about which every joint can move without a collision."""
    posture = np.full(hand.num_joints, 0.5)
    posture[:3] = 0.5, 0.4, 0.5
    posture[3] = 0.0
    return np.clip(posture, hand.joint_lower, hand.joint_upper)


def _inertia(hand: Hand) -> np.ndarray:
    """Inertia [J] kg m^2 about the joints in the model."""
    import mujoco

    model = mujoco.MjModel.from_xml_path(str(hand.model_path))
    return np.array([model.dof_M0[model.joint(name).dofadr[0]] for name in hand.joint_names])


def _plain(result: Identification) -> dict[str, Any]:
    return dataclasses.asdict(result)
