"""`python -m dexsim_real.calibrate --identify`: moves the free joints and fits the drives' parameters to the log.

Each joint in turn follows `dexsim.identification.excitation`. Commands and answers of every exchange are passed to
`dexsim.identification.identify`. Without a calibration there are only angles, which determine the ratio of torque to
inertia; the inertia is then that of the model.
"""

import dataclasses
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from dexsim.calibration.maps import Calibration, load_calibration
from dexsim.core import cli
from dexsim.errors import DexsimError
from dexsim.hand.description import Hand
from dexsim.identification.excitation import excitation
from dexsim.identification.identify import Identification, identify
from dexsim.identification.joint import JointLog
from dexsim_real.calibrate.bench import Bench, CalibrateArguments, Operator, Source, read_logs
from dexsim_real.core.errors import HandError
from dexsim_real.core.log import Kind, LogError
from dexsim_real.core.process import stopping
from dexsim_real.sensors.hand import HandSensing
from dexsim_real.wire.link import check_identity

Marks = list[dict[str, Any]]
"""Annotated exchanges of one joint and signal, in the order of time."""
STIFFNESS, DAMPING = 3.0, 0.1  # Nm/rad, Nm s/rad: initial values of the fit
_SIGNALS: dict[str, dict[str, Any]] = {
    "fit": {},
    "hold-out": {"amplitude": 0.2, "frequency": (0.5, 2.5), "seconds": 3.0, "steps": 3},
}
_TIMESTEP = 0.006  # s, about that of the simulation
_TARE = 0.5  # s
_LOST = 0.02  # share of the exchanges, or of the time, that may be missing
_OFF = 0.05  # share by which the time between two samples may differ from 1 / rate


def identify_hand(arguments: CalibrateArguments, hand: Hand, operator: Operator, **bench: Any) -> list[Identification]:
    """Record or read logs, fit each joint, and write the results. A joint that fails leaves those of the others.

    Raises DexsimError: the hand fails, a log cannot be used, or the data of a joint are insufficient.
    """
    calibration = load_calibration(arguments.calibration, hand) if arguments.calibration else None
    logs = arguments.from_log or (record(arguments, hand, operator, **bench),)
    results, failed = [], dict[str, DexsimError]()
    source, recorded = read_joints(logs, hand, calibration)
    model = mujoco.MjModel.from_xml_path(str(hand.model_path))
    for name, signals in recorded.items():
        if arguments.joints and name not in arguments.joints:
            continue
        try:
            log, holdout = (joint_log(name, marks, hand, source, calibration) for marks in signals.values())
            joint = hand.joint_names.index(name)
            start = {
                "stiffness": STIFFNESS,
                "damping": DAMPING,
                "stall_torque": float(hand.torque_limit[joint]),
                "no_load_speed": float(hand.speed_limit[joint]),
                "inertia": float(model.dof_M0[model.joint(name).dofadr[0]]),  # kg m^2
            }
            substeps = max(round(log.period / _TIMESTEP), 1)
            result = identify(log, start, substeps=substeps, dead_band=None, holdout=holdout)
        except DexsimError as error:
            failed[name] = error
            operator.tell(f"not identified: {name}: {error}")
        else:
            results.append(result)
            operator.tell(result.report())
    if results:
        joints = {result.joint: dataclasses.asdict(result) for result in results}
        cli.write_json(arguments.destination, {"joints": joints})
        operator.tell(f"identified: {arguments.destination}")
    if failed or not results:
        raise HandError(f"not identified: {', '.join(failed) or 'the logs contain none of the chosen joints'}")
    return results


def record(arguments: CalibrateArguments, hand: Hand, operator: Operator, **bench: Any) -> Path:
    """Move the joints and record their answers; returns the log.

    Raises HandError: the procedure failed, or the hand did not answer; the motors are off.
    """
    period = 1.0 / arguments.rate
    posture = np.full(hand.num_joints, 0.5)  # rad, about which every joint can move without a collision
    posture[:4] = 0.5, 0.4, 0.5, 0.0
    posture = np.clip(posture, hand.joint_lower, hand.joint_upper)
    signals = {
        label: excitation(hand, period, posture, arguments.joints or None, **options)
        for label, options in _SIGNALS.items()
    }
    seconds = sum(len(part) * period + 1.5 for signal in signals.values() for part in signal.values())
    operator.tell(f"the fingers move one after the other for {seconds / 60:.0f} minutes: keep clear of them")
    with stopping(), Bench(arguments, hand, operator, **bench) as work:
        try:
            work.set_zero(work.collect(_TARE))  # Otherwise `Safety` would mistake the taxels' zero error for a touch.
            if operator.ask("  Enter starts, s stops:", work.step) is None:
                raise HandError("stopped before anything moved")
            work.await_motors()
            for name in signals["fit"]:
                operator.tell(name)
                for label, targets in signals.items():
                    work.move(targets[name][0])
                    for target in targets[name]:
                        measured = work.step(target) is not None  # An angle that cannot be true is none.
                        work.annotate({"joint": name, "signal": label, "measured": measured})
        finally:  # A signal that comes just before this line is followed by the close of the bench.
            work.close()
    return work.log.path


def read_joints(
    paths: Iterable[Path], hand: Hand, calibration: Calibration | None
) -> tuple[Source, dict[str, dict[str, Marks]]]:
    """How logs of one hand were recorded, and the exchanges by joint and signal; a joint is taken from its last log.

    Raises:
      LogError: not a log of an identification, or of another hand or configuration than the logs before.
      HandError: the calibration is of another hand.
    """
    source, logs = read_logs(paths, "identify")
    if calibration is not None:
        check_identity(source.identity, hand, calibration)
    recorded: dict[str, dict[str, Marks]] = {}
    for records in logs:
        own: dict[str, dict[str, Marks]] = {}
        for mark in (record.content for record in records if record.kind == Kind.TICK):
            own.setdefault(mark["joint"], {label: [] for label in _SIGNALS})[mark["signal"]].append(mark)
        recorded |= own
    return source, recorded


def joint_log(name: str, marks: Marks, hand: Hand, source: Source, calibration: Calibration | None) -> JointLog:
    """The samples of a joint in one signal; without a calibration its torques are unknown.

    Raises LogError: too many exchanges are missing, or they took longer than their period.
    """
    joint, period = hand.joint_names.index(name), 1.0 / source.rate
    given = np.array([mark["measured"] for mark in marks], bool)
    if given.sum() < (1 - _LOST) * len(marks) or len(marks) < 2:
        raise LogError(f"{np.sum(~given)} of {len(marks)} exchanges are missing; check the cable")
    # The fit takes for granted that samples are a period apart.
    time = np.array([mark["sent"] for mark in marks])
    step, missing = np.median(np.diff(time)), time[-1] - time[0] - (len(time) - 1) * period
    if not abs(step - period) <= _OFF * period or not missing <= _LOST * len(time) * period:
        timing = f"{1e3 * step:.1f} ms, expected {1e3 * period:.1f} ms; {1e3 * missing:.0f} ms are missing"
        raise LogError(f"exchanges took {timing}: set the adapter's latency timer to 1 ms, or lower --rate")
    sensing, rows = HandSensing(hand, source.hardware, calibration), np.arange(len(marks))
    commands = np.array([mark["command"] for mark in marks])
    answers = [sensing.measure(sensing.decode(mark["answer"])) for mark in marks if mark["measured"]]
    position, share = np.array([(answer.joint_position[joint], answer.joint_torque[joint]) for answer in answers]).T
    # Few samples are missing: interpolate them.
    torque = None if calibration is None else np.interp(rows, rows[given], share * calibration.torque_scale[joint])
    target = sensing.angles(commands.astype(float))[:, joint]
    return JointLog(period, target, np.interp(rows, rows[given], position), torque, name)
