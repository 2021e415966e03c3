"""Runs a policy on the hand: connects, tares, approaches, runs the policy, and ends with the motors off.

    python -m dexsim_real.run grasp --port /dev/serial/by-id/usb-FTDI_... --command 0.6

The policy is a file or the name of a shipped policy. Everything is compiled before the port is opened. The program
asks before the motors come on (`--yes` does not). They come on at the measured pose, and go off at the end of the
program, even after a failure. `run_policy` is the same as one call, for programs and notebooks.
"""

import contextlib
import dataclasses
import gc
import hashlib
import math
import sys
import termios
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, TextIO, cast

import jax
import numpy as np
import tyro
from rich import box
from rich.console import Console, Group
from rich.live import Live
from rich.markup import escape
from rich.table import Table

from dexsim import load_hand
from dexsim.calibration.maps import calibrated_hand, load_calibration
from dexsim.core import cli
from dexsim.core.config import setting, to_dict
from dexsim.hand.description import Hand
from dexsim.hand.source import record_of, recorded_hand
from dexsim_ppo.policy import load_policy
from dexsim_real.control.controller import Controller, PolicyLoop, Tick, limits_for, prepare_jax
from dexsim_real.control.guard import Guard
from dexsim_real.control.safety import Reaction, Safety
from dexsim_real.core.errors import HandError
from dexsim_real.core.log import Kind, LogWriter
from dexsim_real.core.process import BACKGROUND, change_priority, ignore_signals, leave_realtime, stopping, use_realtime
from dexsim_real.loop import LoopConfig, LoopThread, Pace, Timing, keep_phase
from dexsim_real.sensors.camera import CameraConfig, HeightSensor, ObjectSensors, open_masks
from dexsim_real.sensors.hand import HandMeasurement, HandSensing
from dexsim_real.sensors.imu import UPRIGHT_X, Imu
from dexsim_real.wire.driver import open_port
from dexsim_real.wire.link import UNCONFIRMED

_SWITCH = sys.getswitchinterval()
_QUESTION = (
    "The motors come on at this pose, then the hand moves to its start posture.\n"
    "Is the power switch within reach, and the hand's room clear? [y/N] "
)
_STILL = 5.0  # s to wait for a hand that is still, whose motors can come on
_BLIND = 0.1  # share of the time without a measurement that a run may have, such as a cable that was out for a moment
_HELD = 0.5  # share of the time in which `Safety` may have held the hand

_LIVE = 0.25  # s between two updates of the tables


@dataclasses.dataclass(frozen=True, kw_only=True)
class RunArguments(LoopConfig):
    """Options of `python -m dexsim_real.run`."""

    policy: Annotated[str, tyro.conf.Positional]
    """Policy file, or name of a shipped policy ("grasp")."""
    port: str
    """Serial port of the XHand (names under /dev/serial/by-id are stable), or sdk:MODULE:FUNCTION for the driver of
    another hand (docs/bridge.md)."""
    hand: str = ""
    """The TOML of a hand of your own, where it is not in the place that the policy's file names."""
    command: float = setting(0.5, unit="1", low=0.0, high=1.0)
    """Grip command in [0, 1]."""
    axis: tuple[float, ...] = setting((), unit="1", low=-1.0, high=1.0)
    """Axis to turn about, for a policy trained with several (`--env.turn.axes`); empty: the palm's normal, 1 0 0."""
    seconds: float = setting(30.0, unit="s", low=0.1, high=86400.0)
    """Duration of the run, after the approach."""
    motors_off: bool = False
    """Measure, compute and display everything with the motors off."""
    yes: bool = False
    """Do not ask before the motors come on (for scripts and the emulated hand)."""
    calibration: Path | None = None
    """Calibration file of this hand; None only with --uncalibrated."""
    uncalibrated: bool = False
    """Run without a calibration, on default scales (`--hardware.current-scale`, `--hardware.force-per-count`)."""
    imu: str | None = None
    """Serial port of the IMU in the object; None if the policy needs no IMU."""
    imu_mount: tuple[float, float, float, float] = setting(UPRIGHT_X, unit="1", low=-1.0, high=1.0)
    """Orientation (w, x, y, z) of the IMU in the object; by default its z is along the object's x."""
    lean: tuple[float, ...] = setting((), unit="rad", low=-1.57, high=1.57)
    """How much higher the wrist is than the fingers, and the thumb's side than the little finger's, by a level on the
    palm; empty: as in training. An IMU measures it, too."""
    camera: str | None = None
    """Source of the object's masks: camera number, video file, unix:PATH or MODULE:FUNCTION. None if the policy needs
    no camera."""
    fixed_object: bool = False
    """Run without a camera: assume that the object stays at its nominal position."""
    guard: bool = True
    """Start a second process that turns the motors off when this one dies or freezes."""
    approach: float = setting(2.0, unit="s", low=0.0, high=60.0)
    """Time to move from the measured pose to the task's start posture; 0 stays at the measured pose."""
    place: float = setting(0.0, unit="s", low=0.0, high=600.0)
    """Time in the start posture to put the object into the hand, aligned with the palm if the IMU is used."""
    log: Path | None = None
    """Log file; None for a new file in runs/real."""
    output: Path | None = None
    """JSON file for the summary; None writes no file."""
    realtime: bool = True
    """Request real-time priority; continue without it if not permitted."""
    quiet: bool = False
    """Hide the live status."""
    optics: CameraConfig = setting(CameraConfig())
    """Pose of the camera, and colour of the object."""

    def __post_init__(self):
        super().__post_init__()
        if not any(self.imu_mount):
            raise HandError("--imu-mount 0 0 0 0: is no orientation (w, x, y, z)")
        if len(self.lean) not in (0, 2):
            raise HandError(f"--lean: expected 2 angles in rad, got {len(self.lean)}")
        if (self.calibration is None) != self.uncalibrated:
            raise HandError("give either --calibration FILE, or --uncalibrated to run on default scales")


@dataclasses.dataclass(frozen=True)
class RunResult:
    """How a run ended, and what it measured."""

    end: str  # why: "time is over", a safety reaction, a signal, or what failed
    code: int  # 0 for a whole run, 1 if something ended it or is missing, 128 + n after signal n
    problem: str  # what ended it early, or what it lacks; empty for a whole run, and after a signal
    log: Path  # of all frames and ticks, for `python -m dexsim_real.replay`
    summary: dict[str, Any]
    """Statistics: seconds, forces in N, successes, jitter, link, cycles by safety reason. If `motors_off` is false, the
    hand has not confirmed that they are: press the emergency stop. `missing` lists what is no success."""


def run_policy(
    policy: str | Path, port: str, calibration: str | Path | None = None, *, seconds: float = 30.0, **options: Any
) -> RunResult:
    """Run a policy on a hand: connect, tare, approach, policy, motors off. Asks before the motors come on.

        result = dexsim_real.run_policy("grasp", "/dev/ttyUSB0", "hand.toml", seconds=10, command=0.6, camera="0")

    Args:
      policy: file, or name of a shipped policy.
      port: serial port of the XHand, or sdk:MODULE:FUNCTION for the driver of another hand.
      calibration: file of this hand; None for default scales.
      seconds: duration after the approach.
      options: further fields of `RunArguments`; `yes=True` asks nothing.

    Raises:
      HandError: the hand or a sensor cannot be reached, or nobody said yes; nothing has moved.
      DexsimError: the policy, the calibration or an option cannot be used.
    """
    file = None if calibration is None else Path(calibration)
    arguments = RunArguments(
        policy=str(policy), port=port, calibration=file, uncalibrated=file is None, seconds=seconds, **options
    )
    with stopping():
        return execute(arguments)


def execute(arguments: RunArguments) -> RunResult:
    """Run with these options, within `stopping`; see `run_policy`."""
    asks = not (arguments.yes or arguments.motors_off)
    if asks and not all(stream and stream.isatty() for stream in (sys.stdin, sys.stderr)):
        raise HandError("cannot ask for confirmation without a terminal; give --yes or --motors-off")
    prepare_jax()
    cli.enable_caches()
    session = Session(arguments)
    reason, code = "", 0
    try:
        try:
            session.run()
        except HandError as error:
            reason, code = str(error), 1
            if not (session.started or session.safety.engaged):  # Nothing has moved.
                raise
        except KeyboardInterrupt:
            reason, code = "Ctrl-C", 130
        except SystemExit as stop:
            code = stop.code if isinstance(stop.code, int) and stop.code > 128 else 1
            reason = f"signal {code - 128}" if code > 128 else f"a driver exits: {stop.code}"
        except BaseException as error:
            reason = f"failure: {error!r}"
            raise
        finally:
            session.close(reason)
    finally:  # Again: the one signal that interrupts may have come just before the line above.
        session.close(reason)
    summary = session.summary()
    code = code if summary["motors_off"] else 1
    problem = session.end if code == 1 else "; ".join(summary["missing"]) if code == 0 else ""
    return RunResult(session.end, 1 if problem else code, problem, session.log.path, summary)


class Outcome:
    """Whether a run did what it was started for: a hand that was gone or held, or lost records, are no success."""

    def __init__(self) -> None:
        self._ticks = self._blind = self._held = self._wrong = 0
        self._reason = self._silence = ""  # of the newest hold, and of the newest refusal

    def add(self, target: np.ndarray | None, safety: Safety) -> None:
        """Count a tick; `target` [J] is the policy's, None when no measurement was young enough."""
        self._ticks += 1
        if target is None:
            self._blind += 1
            self._silence = safety.alarms.refused or self._silence
        else:
            self._wrong += not np.isfinite(target).all()
        reaction, reason = safety.last
        if safety.engaged and reaction >= Reaction.HOLD:
            self._held += 1
            self._reason = reason

    def missing(self, log: LogWriter) -> list[str]:
        """What the run lacks, one line each; empty for a whole run. `log` should be closed."""
        total, why = max(self._ticks, 1), f" ({self._silence})" if self._silence else ""
        blind, held, actions = self._blind / total, self._held / total, self._ticks - self._blind
        lines = {
            f"no measurement for {100 * blind:.0f} % of the run{why}": blind > _BLIND,
            f"{self._wrong} of {actions} actions of the policy were not finite": self._wrong,
            f"the hand was held for {100 * held:.0f} % of the run, last because: {self._reason}": held > _HELD,
            log.losses: log.losses,
        }
        return [line for line, true in lines.items() if true]


class Session:
    """A run: the constructor opens only files, `run` connects.

    Raises DexsimError: the policy, calibration or log cannot be used.
    """

    def __init__(self, arguments: RunArguments):
        self.arguments = arguments
        guarded = arguments.guard and not arguments.motors_off
        policy = load_policy(arguments.policy)
        hand = recorded_hand(policy.hand, arguments.hand, arguments.policy) or load_hand()
        guard = Guard(arguments.port, arguments.link, hand) if guarded else None
        calibration = load_calibration(arguments.calibration, hand) if arguments.calibration else None
        self.port = open_port(arguments.port, hand, arguments.link)
        self.port.tap = self._tap
        self.controller = Controller(policy, calibrated_hand(hand, calibration), arguments.axis)
        self.controller.check_measured(self.port.missing)
        self.sensing = HandSensing(hand, arguments.hardware, calibration)
        self.controller.warm()
        self.sensing.measure(np.zeros((), self.sensing.block))
        self.safety = Safety(hand, limits_for(arguments.safety, self.controller), self._react)
        # Not earlier: compiling in a real-time thread would starve the machine.
        realtime = arguments.realtime and use_realtime()
        self.log = LogWriter(arguments.log or Path("runs/real") / time.strftime("%Y%m%d-%H%M%S.log"))
        rate = keep_phase(arguments.rate, policy.control_rate)
        self.loop = LoopThread(self.port, self.sensing, self.safety, rate, guard)
        self.loop.retared = self._retare
        self.view = StatusView(f"{policy.task} on {arguments.port}", self.summary, self._hand_tables, arguments.quiet)
        self.policy: PolicyLoop | None = None  # once the hand is connected
        self.pace = Pace(policy.control_rate)
        self.started = 0.0
        self.outcome = Outcome()
        self.newest: Tick | None = None
        self.end, self._closed = "not started", False
        if arguments.realtime and not realtime:
            self._note("without real-time priority: expect jitter on a busy machine (docs/hardware.md)")

    def run(self) -> None:
        """Connect with the motors off and tare, ask, turn the motors on, approach the start posture, and run the policy
        until time or `Safety` ends it.

        Raises HandError: something is missing, the answer was not yes, or `Safety` or a failure ended the run.
        """
        arguments, sensing = self.arguments, self.sensing
        for line in self.port.greet(sensing.hand, sensing.calibration):
            self._note(line)
        for line in self.loop.tare():
            self._note(f"warning: {line}")
        self._write_meta()
        self.loop.start()
        self._await_pose()
        self.policy = policy = PolicyLoop(
            self.controller,
            self.safety,
            open_objects(arguments, self.controller),
            command=arguments.command,
            approach_seconds=arguments.approach,
            place_seconds=arguments.place,
            motors_off=arguments.motors_off,
        )
        if not (arguments.yes or arguments.motors_off):
            self.view.show()
            ask()
            self._await_pose()  # The hand may have been moved or lost meanwhile.
        sys.setswitchinterval(2e-4)
        gc.collect()
        gc.freeze()
        with self.view:
            if not arguments.motors_off:
                self.loop.engage()
                self._await_motors()
            pace = Pace(arguments.rate)
            while policy.approach(time.monotonic()):
                self._check()
                pace.wait()
            policy.begin()
            self._note("the policy starts")
            self._run_policy(policy)
            self.end = "time is over"

    def close(self, reason: str = "") -> None:
        """Turn the motors off and close everything; may be called at any stage, and again."""
        ignore_signals()
        if self._closed:
            return
        self.end = reason or self.end
        self.loop.stop()
        if self.loop.driven:
            self.end += f"; {UNCONFIRMED}: press the emergency stop"
        if self.policy:
            self.policy.objects.close()
        self._note(f"end: {self.end}")
        self.log.add(Kind.END, self.summary())
        self.log.close()
        gc.unfreeze()
        sys.setswitchinterval(_SWITCH)
        leave_realtime()
        self._closed = True

    def summary(self) -> dict[str, Any]:
        """Results and statistics of the run so far; JSON-able."""
        loop, safety, policy = self.loop, self.safety, self.policy
        reaction, reason = safety.last
        summary: dict[str, Any] = {
            "end": self.end,
            "motors_off": not loop.driven,
            "seconds": round(time.monotonic() - self.started, 3) if self.started else 0.0,
            "command": self.arguments.command,
            "reaction": f"{reaction.name.lower()} {reason}".strip(),
            "problem": safety.problem,
            "safety": dict(safety.counts),
            "mean_finger_force": float(policy.finger_force.sum() / max(policy.ticks, 1)) if policy else 0.0,
            "policy_jitter": self.pace.jitter.summary(),
            "exchange_jitter": loop.pace.jitter.summary(),
            "round_trip": loop.round_trip.summary(),
            "link": dataclasses.asdict(self.port.counts),
            "log": str(self.log.path),
            "log_dropped": self.log.dropped,
            "missing": self.outcome.missing(self.log),
        }
        if policy and policy.goals:
            times = [t - self.started for t in policy.goals.times]
            summary |= {"successes": policy.goals.successes, "success_times": times}
        return summary

    def _hand_tables(self) -> Table | str:
        """What the view shows of the hand; empty without a measurement. Called from the view's thread."""
        sample, sent = self.safety.sample, self.safety.last[0] != Reaction.RELAX
        if sample is None:
            return ""
        target = self.safety.commanded if sent else self.newest.target if self.newest else None
        return hand_tables(self.sensing.hand, sample.measured, target, sent)

    def _await_pose(self) -> None:
        """Check that a hand answers plausibly now."""
        begin = time.monotonic()
        while (sample := self.safety.sample) is None or sample.time < begin:
            self.loop.check()
            if time.monotonic() > begin + 1.0:
                problem = self.safety.problem and f"{self.safety.problem}; check `--hardware.joint-offset`"
                silence = self.safety.alarms.refused or "the hand stopped answering; check the cable and the power"
                raise HandError(f"{self.arguments.port}: {problem or silence}")
            time.sleep(0.01)

    def _await_motors(self) -> None:
        until = time.monotonic() + _STILL
        while not self.safety.anchor:
            self._check()
            if time.monotonic() > until:
                raise HandError(f"{self.arguments.port}: the motors did not come on: {self.safety.last[1]}")
            time.sleep(0.01)

    def _check(self) -> None:
        self.loop.check()
        if self.safety.latched:
            raise HandError(f"stopped: {self.safety.latched}")

    def _run_policy(self, policy: PolicyLoop) -> None:
        """Tick until the time is over."""
        self.started = time.monotonic()
        self.loop.pace.jitter, self.loop.round_trip = Timing(), Timing()  # without those of the start
        self.pace = Pace(self.controller.policy.control_rate)
        # A tick starts when a request has just been sent; rates from `keep_phase` keep it so.
        self.pace.next = self.loop.free(self.pace.next)
        while (now := time.monotonic()) < self.started + self.arguments.seconds:
            self._check()
            tick = policy.tick(now)
            self.outcome.add(tick.target if tick else None, self.safety)
            if tick is not None:
                self.newest = tick
                fields = {name: getattr(tick, name) for name in ("observation", "action", "target")}
                sample = policy.sample
                fields |= {"sequence": sample.sequence, "age": now - sample.time, "answer": sample.state.tobytes()}
                self.log.add(Kind.TICK, fields | {"readings": vars(tick.readings)}, now)
            self.pace.wait()
        self._check()

    def _tap(self, direction: str, data: bytes) -> None:
        self.log.add(Kind.SENT if direction == "tx" else Kind.RECEIVED, (self.port.counts.sent, data))

    def _retare(self, sequence: int, lines: list[str]) -> None:
        """Zeros have moved, or taxels got stuck: a replay needs to know from which exchange on."""
        self.log.add(Kind.META, {"tare": self.sensing.tare, "from": sequence})
        for line in lines:
            self._note(f"warning: {line}")

    def _note(self, text: str) -> None:
        self.log.add(Kind.NOTE, text)
        self.view.note(text)

    def _react(self, text: str) -> None:
        """Log a change of the safety reaction; clips are too frequent for the terminal."""
        self.log.add(Kind.NOTE, text)
        if text.startswith(("hold", "relax")) and self.safety.engaged:
            self.view.note(text)

    def _write_meta(self) -> None:
        arguments, policy = self.arguments, self.controller.policy
        leaves = b"".join(np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(policy.params))
        self.log.add(
            Kind.META,
            {
                "task": policy.task,
                "spec": to_dict(policy.spec),
                "policy": arguments.policy,
                "policy_sha256": hashlib.sha256(leaves).hexdigest(),
                "hand": record_of(self.sensing.hand),
                "calibration": arguments.calibration.read_text() if arguments.calibration else "",
                "tare": self.sensing.tare,
                "hardware": to_dict(arguments.hardware),
                "safety": to_dict(self.safety.config),
                "command": arguments.command,
                "control_rate": policy.control_rate,
                "clock": time.time(),
                "environment": cli.environment_report(),
            },
        )


def ask() -> None:
    """Ask on the terminal whether the motors may come on. Raises HandError: the answer is not yes."""
    with contextlib.suppress(OSError, ValueError, termios.error):
        termios.tcflush(sys.stdin.fileno(), termios.TCIFLUSH)  # What was typed before the question is no answer to it.
    print(_QUESTION, end="", file=sys.stderr, flush=True)
    if sys.stdin.readline().strip().lower() not in ("y", "yes"):
        raise HandError("not confirmed: the motors stayed off")


def open_objects(arguments: RunArguments, controller: Controller) -> ObjectSensors:
    """Open the camera and the IMU of a run.

    Raises HandError: the policy needs a sensor that is not given, or a sensor cannot be opened.
    """
    spec, needed = controller.spec, controller.sources
    if "imu" in needed and not arguments.imu:
        raise HandError("the policy observes the object's orientation; give the IMU's port with --imu")
    if "camera" in needed and not (arguments.camera or arguments.fixed_object):
        raise HandError("the policy observes the object's height; give --camera, or --fixed-object to assume it")
    gravity = gravity_of(arguments.lean, controller.hand, spec.gravity) if arguments.lean else spec.gravity
    objects = ObjectSensors(spec.reference, gravity)
    try:
        if arguments.camera:
            objects.camera = HeightSensor(open_masks(arguments.camera, arguments.optics), arguments.optics, spec)
        if arguments.imu:
            objects.imu = imu = Imu(arguments.imu, arguments.imu_mount)
            imu.wait()
    except BaseException:
        objects.close()
        raise
    return objects


def gravity_of(lean: Sequence[float], hand: Hand, nominal: Sequence[float]) -> tuple[float, float, float]:
    """Gravity in the palm frame from the measured `lean`; the palm is up or down as with the `nominal` gravity."""
    along, across = math.sin(lean[0]), -math.sin(lean[1])  # z: to the fingers, y: to a right thumb
    out = math.copysign(math.sqrt(max(1.0 - along**2 - across**2, 0.0)), nominal[0])
    return out, across if hand.side == "right" else -across, along


# --- the status on the terminal ---------------------------------------------------------------------


class _Lasting:
    """A stream to which writing never fails: a terminal that was closed, or a pipe without a reader, ends no run."""

    def __init__(self, stream: TextIO):
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        with contextlib.suppress(OSError):
            self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        with contextlib.suppress(OSError):
            self._stream.flush()


class StatusView:
    """Shows the state of a run from a background thread, which calls `summary` and `hand`. A context manager."""

    def __init__(self, title: str, summary: Callable[[], dict[str, Any]], hand: Callable[[], Table | str], quiet: bool):
        self.console = _console(quiet)
        self._title, self._summary, self._hand = title, summary, hand
        live = self.console.is_terminal and not quiet
        self._live = Live(console=self.console, auto_refresh=False, transient=True) if live else None
        self._notes: deque[str] = deque(maxlen=1000)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="view", daemon=True)

    def __enter__(self) -> "StatusView":
        if self._live:
            self._live.start()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join(2.0)
        if self._live:
            self._live.stop()

    def note(self, text: str) -> None:
        """Print a line. While the view runs, its thread does, so the caller never waits for a terminal."""
        self._notes.append(text)
        if not self._thread.is_alive():
            self._print_notes()

    def show(self) -> None:
        """Print the tables once."""
        self.console.print(self._tables())

    def _print_notes(self) -> None:
        with contextlib.suppress(IndexError):  # Another thread may have printed the last one.
            while True:
                self.console.print(self._notes.popleft(), highlight=False, markup=False, soft_wrap=True)

    def _run(self) -> None:
        change_priority(BACKGROUND)
        while not self._stop.wait(_LIVE):
            self._print_notes()
            if self._live:
                self._live.update(self._tables(), refresh=True)
        self._print_notes()

    def _tables(self) -> Group:
        return Group(self._hand(), "", _rows(self._title, self._summary()))


def _console(quiet: bool = False) -> Console:
    stream = cast(TextIO, _Lasting(sys.stderr)) if sys.stderr else None
    return Console(stderr=True, quiet=quiet, file=stream)


def _rows(title: str, summary: dict[str, Any]) -> Table:
    """A row for each entry that says something."""

    def short(value: Any) -> str:
        return f"{value:.4g}" if isinstance(value, float) else str(value)

    # Escaped, since an error may have text in brackets, which Rich would take for its markup.
    table = Table(title=escape(title), title_justify="left", show_header=False, box=None)
    for name, value in summary.items():
        if isinstance(value, dict):
            value = ", ".join(f"{k} {short(v)}" for k, v in value.items() if v)
        if value not in ("", []):
            table.add_row(name.replace("_", " "), escape(short(value)))
    return table


def hand_tables(hand: Hand, measured: HandMeasurement, target: np.ndarray | None, sent: bool) -> Table:
    """Joints on the left, with the error registers of their boards; fingertips on the right.

    `target` [J] rad are the newest joint targets, None before the first; `sent` tells whether the motors follow them.
    """
    heat, force = measured.temperature, measured.finger_force
    title = "target" if sent else "(not sent)"
    joints = _table("joint (rad)", "measured", title, "A", "degC", "errors: palm", "joint", "tip")
    for joint, name in enumerate(hand.joint_names):
        joints.add_row(
            f"{joint:2d} {name}",
            f"{measured.joint_position[joint]:.3f}",
            "-" if target is None else f"{target[joint]:.3f}",
            "-" if np.isnan(measured.current[joint]) else f"{measured.current[joint]:.2f}",
            f"{heat[joint]:.0f}",
            *(f"{bits:04x}" if bits else "-" for bits in measured.errors[joint]),
        )
    fingers = _table("finger", "N", "degC")
    for name, newtons, degrees in zip(hand.finger_names, force, heat[hand.num_joints :], strict=False):
        fingers.add_row(name, f"{newtons:.1f}", f"{degrees:.0f}")
    fingers.add_row("sum", f"{force.sum():.1f}", "")
    fingers.add_row("palm board", "", f"{heat[-1]:.0f}")
    both = Table.grid(padding=(0, 3))
    both.add_row(joints, fingers)
    return both


def _table(first: str, *others: str) -> Table:
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1), collapse_padding=True, pad_edge=False, show_edge=False)
    table.add_column(first, no_wrap=True)
    for name in others:
        table.add_column(name, justify="right", no_wrap=True)
    return table


# --- the command ------------------------------------------------------------------------------------


def main(argv: Sequence[str] | None = None) -> int:
    """The command. Returns its exit code: 0, or 1 when `Safety` or a failure ended the run or something is missing."""
    arguments = cli.parse(RunArguments, argv, prog="python -m dexsim_real.run", description="Run a policy on the hand.")
    inputs = {"policy": arguments.policy, "calibration": arguments.calibration, "TOML of the hand": arguments.hand}
    cli.check_no_overwrite({"--log": arguments.log, "--output": arguments.output}, inputs)
    if arguments.output:
        cli.check_writable(arguments.output)
    with stopping(leaving=argv is None):
        result = execute(arguments)
        if result.problem:
            with contextlib.suppress(OSError):  # The terminal may be gone, and the summary must still be written.
                print(f"error: {result.problem}", file=sys.stderr)
        if not arguments.quiet:
            _console().print(_rows(f"{arguments.policy}: {result.end}", result.summary))
        if arguments.output:
            cli.write_json(arguments.output, result.summary)
    return result.code


if __name__ == "__main__":
    cli.run(main)
