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

TASK = "identify"
STIFFNESS, DAMPING = 3.0, 0.1  # Nm/rad, Nm s/rad: initial values of the fit
_SIGNALS: dict[str, dict[str, Any]] = {
    "fit": {},
    "hold-out": {"amplitude": 0.2, "chirp_frequency": (0.5, 2.5), "chirp_seconds": 3.0, "step_count": 3},
}
_TIMESTEP = 0.006  # s, about that of the simulation
_TARE = 0.5  # s
_LOST = 0.02  # share of the exchanges that may be missing


def identify_hand(arguments: CalibrateArguments, hand: Hand, operator: Operator, **bench: Any) -> list[Identification]:
    """Record or read logs, fit each joint, and write the results.

    Raises:
      DexsimError: the hand fails, a log cannot be used, or the data are insufficient.
    """
    for name in arguments.joints:
        if name not in hand.joint_names:
            raise HandError(f"no joint {name!r}; choose from {', '.join(hand.joint_names)}")
    calibration = load_calibration(arguments.calibration, hand) if arguments.calibration else None
    logs = arguments.from_log or (record(arguments, hand, operator, **bench),)
    found = []
    for name, (log, check) in read_logs(logs, hand, calibration).items():
        if arguments.joints and name not in arguments.joints:
            continue
        joint = hand.joint_names.index(name)
        start = {
            "stiffness": STIFFNESS,
            "damping": DAMPING,
            "stall_torque": float(hand.torque_limit[joint]),
            "no_load_speed": float(hand.speed_limit[joint]),
            "inertia": float(_inertia(hand)[joint]),
        }
        found.append(
            identify(
                log,
                start,
                fit=FIT,
                substeps=max(round(log.period / _TIMESTEP), 1),
                dead_band=(0.0, 0.03) if arguments.dead_band else None,
                holdout=check,
            )
        )
        operator.tell(found[-1].report())
    if not found:
        raise HandError("the logs contain none of the chosen joints; check --joints and --from-log")
    cli.write_json(arguments.destination, {"joints": {result.joint: _plain(result) for result in found}})
    operator.tell(f"identified: {arguments.destination}")
    return found


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
            work.safety.engage()
            for name in next(iter(signals.values())):
                operator.tell(name)
                for label, targets in signals.items():
                    loop.move(targets[name][0])
                    loop.recording = True
                    for target in targets[name]:
                        loop.step(target)
                        loop.mark({"joint": name, "signal": label})
                    loop.recording = False
        finally:  # A signal that comes just before this line is followed by the close of the workbench.
            work.loop.close()
    return work.log.path


def read_logs(
    paths: Iterable[Path], hand: Hand, calibration: Calibration | None
) -> dict[str, tuple[JointLog, JointLog | None]]:
    """By joint, the log to fit and the held-out log to test on, None if there is none.

    Raises:
      LogError: not a log of an identification, or too many exchanges are missing.
    """
    parts: dict[tuple[str, str], list] = {}
    hardware, period = HardwareConfig(), 0.0
    for path in paths:
        task, received = None, (-1, b"")  # The first exchange that is recorded may be unanswered.
        with reading(path):
            for record in LogReader(path):
                content = record.content
                if record.kind == Kind.META and "task" in content:
                    task, period = content["task"], 1.0 / content["rate"]
                    hardware = from_dict(HardwareConfig, content["hardware"])
                elif record.kind == Kind.SENT:
                    sent = content
                elif record.kind == Kind.RECEIVED:
                    received = content
                elif record.kind == Kind.TICK and task == TASK:
                    answer = received[1] if received[0] == content["sequence"] else None
                    parts.setdefault((content["joint"], content["signal"]), []).append((sent[1], answer))
        if task != TASK:
            found = f"it is a log of {task!r}" if task else "it ends before the hand was ready"
            raise LogError(f"{path}: this is not a log of --identify: {found}")
    logs = {key: _joint_log(key[0], rows, hand, hardware, calibration, period) for key, rows in parts.items()}
    return {name: (logs[name, "fit"], logs.get((name, "hold-out"))) for name, label in logs if label == "fit"}


def _joint_log(
    name: str,
    rows: list[tuple[bytes, bytes | None]],
    hand: Hand,
    hardware: HardwareConfig,
    calibration: Calibration | None,
    period: float,
) -> JointLog:
    """The samples of a joint, given the frames of every command and of its answer, None without one."""
    joint = hand.joint_names.index(name)
    sign, offset = hardware.joint_sign[joint], hardware.joint_offset[joint]
    lost = np.array([answer is None for _, answer in rows])
    if np.mean(lost) > _LOST:
        raise LogError(f"{name}: {np.sum(lost)} of {len(lost)} exchanges are missing; check the cable and record again")
    answers = [answer for _, answer in rows if answer is not None]
    state = np.array([frames.decode_state(frame[frames.HEADER.size : -2])["joint"] for frame in answers])
    command = np.array([frames.decode_command(frame[frames.HEADER.size : -2])["position"] for frame, _ in rows])
    target, position = (part[:, joint].astype(float) * sign + offset for part in (command, state["position"]))
    # Few samples are missing: interpolate them.
    time = np.arange(len(rows))
    position = np.interp(time, time[~lost], position)
    torque = None
    if calibration is not None:
        current = state["current"].astype(float) * calibration.current_per_count
        torque = np.array(joint_torque(calibration, current))[:, joint]
        torque = np.interp(time, time[~lost], torque)
    return JointLog(period, target, position, torque, name)


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


def _plain(found: Identification) -> dict[str, Any]:
    return dataclasses.asdict(found)
