"""A run on the hand: connect, tare, approach, run the policy, and end with the motors off."""

import dataclasses
import gc
import hashlib
import sys
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

from dexsim import load_hand
from dexsim.calibration.maps import calibrated_hand, load_calibration
from dexsim.core import cli
from dexsim.core.config import to_dict
from dexsim.hand.source import record_of, recorded_hand
from dexsim_ppo.export import load_exported
from dexsim_ppo.policy import load_policy
from dexsim_real.control.controller import IDENTITY, Controller, Tick
from dexsim_real.control.goals import TurnGoals
from dexsim_real.control.motors_off import UNCONFIRMED
from dexsim_real.control.safety import Safety
from dexsim_real.control.servo import Servo
from dexsim_real.core.errors import HandError
from dexsim_real.core.log import Kind, LogWriter
from dexsim_real.core.process import ignore_signals, leave_realtime, use_realtime
from dexsim_real.core.timing import Pace, Timing, keep_phase
from dexsim_real.run import consent
from dexsim_real.run.guard import Guard
from dexsim_real.run.object_sensors import ObjectSensors
from dexsim_real.run.options import RunArguments
from dexsim_real.run.outcome import Outcome
from dexsim_real.run.overview import overview
from dexsim_real.run.status import StatusView
from dexsim_real.sensors.hand import HandSensing
from dexsim_real.wire.frames import Mode, empty_state
from dexsim_real.wire.identity import check_identity
from dexsim_real.wire.link import checked, greet, refusal_of
from dexsim_real.wire.serial_hand import open_port

_TARE_SAMPLES = 30
_SWITCH = sys.getswitchinterval()
_PATIENCE = 60.0  # s to wait until the camera sees the object
_STILL = 5.0  # s to wait for a hand that is still, whose motors can come on


class Session:
    """A run: the constructor opens only files, `prepare` connects with the motors off, `run` turns them on.

    Raises:
      DexsimError: the policy, calibration or log cannot be used.
    """

    def __init__(self, arguments: RunArguments):
        self.arguments = arguments
        wanted = arguments.guard and not arguments.motors_off
        self.guard = Guard(arguments.port, arguments.link) if wanted else None
        exported = arguments.policy.endswith((".npz", ".onnx"))
        policy: Any = (load_exported if exported else load_policy)(arguments.policy)
        hand = recorded_hand(policy.hand, arguments.hand, arguments.policy) or load_hand()
        calibration = load_calibration(arguments.calibration, hand) if arguments.calibration else None
        self.controller = Controller(policy, calibrated_hand(hand, calibration))
        self.sensing = HandSensing(hand, arguments.hardware, calibration)
        self.controller.warm()
        self.sensing.measure(empty_state())
        config = arguments.safety
        config = dataclasses.replace(config, watchdog=max(config.watchdog, 2.5 * self.controller.period))
        self.safety = Safety(hand, config, self._react)
        # Not earlier: compiling in a real-time thread would starve the machine.
        realtime = arguments.realtime and use_realtime()
        path = arguments.log or Path("runs/real") / time.strftime("%Y%m%d-%H%M%S.log")
        self.log = LogWriter(path)
        self.port = open_port(arguments.port, arguments.link, self._tap)
        rate = keep_phase(arguments.rate, policy.control_rate)
        beat = self.guard.beat if self.guard else lambda more: None
        self.servo = Servo(self.port, self.sensing, self.safety, rate, beat)
        self.servo.retared = self._retare
        self.view = StatusView(f"{policy.task} on {arguments.port}", lambda: overview(self), arguments.quiet)
        self.objects: ObjectSensors | None = None
        self.goals: TurnGoals | None = None
        self.compute, self.pace = Timing(), Pace(policy.control_rate)
        self.started = self.force = self.forces = 0.0
        self.outcome = Outcome()
        self.tick: Tick | None = None
        self.end, self._closed = "not started", False
        if arguments.realtime and not realtime:
            self._note("without real-time priority: expect jitter on a busy machine (docs/hardware.md)")

    # --- stages ---------------------------------------------------------------------------------

    def prepare(self) -> None:
        """Connect with the motors off, tare the taxels, start camera and IMU.

        Raises:
          HandError: something is missing or does not answer.
        """
        for line in greet(self.port):
            self._note(line)
        for note in check_identity(getattr(self.port, "identity", None), self.sensing.hand, self.sensing.calibration):
            self._note(note)
        if self.arguments.tare:
            self._tare()
        self._write_meta()
        self.servo.start()
        self._await_pose()
        self.objects = ObjectSensors(self.arguments, self.controller)
        spec = self.controller.spec
        if self.arguments.imu and spec.turn:
            self.goals = TurnGoals(spec.turn, np.asarray(spec.reference))

    def run(self) -> None:
        """Ask, turn the motors on, approach the start posture, and run the policy until time or `Safety` ends it.

        Raises:
          HandError: the answer was not yes, or `Safety` or a failure ended the run.
        """
        if not (self.arguments.yes or self.arguments.motors_off):
            self.view.show()
            consent.ask()
            self._await_pose()  # The hand may have been moved or lost meanwhile.
        sys.setswitchinterval(2e-4)
        gc.collect()
        gc.freeze()
        with self.view:
            if self.guard:
                self.guard.arm()
            if not self.arguments.motors_off:
                self.servo.engage()
                self._await_motors()
            self._approach()
            self.controller.start(self.safety.commanded)
            self._note("the policy starts")
            self.end = self._loop()

    def close(self, reason: str = "") -> None:
        """Turn the motors off and close everything; may be called at any stage, and again."""
        ignore_signals()
        if self._closed:
            return
        self.end = reason or self.end
        self.servo.stop()
        if self.guard:
            self.guard.dismiss(off=not self.servo.driven)
        if self.servo.driven:
            self.end += f"; {UNCONFIRMED}: press the emergency stop"
        if self.objects:
            self.objects.close()
        self._note(f"end: {self.end}")
        self.log.add(Kind.END, self.summary())
        self.log.close()
        gc.unfreeze()
        sys.setswitchinterval(_SWITCH)
        leave_realtime()
        self._closed = True

    def summary(self) -> dict[str, Any]:
        """Results and statistics of the run; JSON-able."""
        servo, safety = self.servo, self.safety
        summary = {
            "end": self.end,
            "motors_off": not self.servo.driven,
            "seconds": round(time.monotonic() - self.started, 3) if self.started else 0.0,
            "command": self.arguments.command,
            "policy_jitter": self.pace.jitter.summary(),
            "policy_compute": self.compute.summary(),
            "exchange_jitter": servo.pace.jitter.summary(),
            "round_trip": servo.round_trip.summary(),
            "missed_for_the_hand": servo.waited,
            "link": dataclasses.asdict(self.port.counts),
            "safety": dict(safety.counts),
            "mean_finger_force": self.force / self.forces if self.forces else 0.0,
            "log": str(self.log.path),
            "log_dropped": self.log.dropped,
            "missing": self.outcome.missing(self.log),
        }
        if self.goals:
            times = [t - self.started for t in self.goals.times]
            summary |= {"successes": self.goals.successes, "success_times": times}
        return summary

    # --- pieces ---------------------------------------------------------------------------------

    def _tare(self) -> None:
        states, until = list[np.ndarray](), time.monotonic() + 5.0
        while len(states) < _TARE_SAMPLES and time.monotonic() < until:
            reply = self.port.exchange(self.sensing.command(self.sensing.hand.joint_lower, Mode.PASSIVE))
            if reply is not None:
                states.append(checked(reply, time.monotonic()).state)
            elif (refusal := refusal_of(self.port)) and refusal.serious:
                raise HandError(f"{self.arguments.port}: {refusal.text}")
        if len(states) < _TARE_SAMPLES:
            raise HandError(
                f"{self.arguments.port}: only {len(states)} answers in 5 s, cannot tare the taxels; check the cable"
            )
        for line in self.sensing.set_tare(states):
            self._note(f"warning: {line}")

    def _await_pose(self) -> None:
        if self.servo.wait_fresh(1.0) is None:
            self._check_servo()
            if self.safety.problem:
                raise HandError(f"{self.arguments.port}: {self.safety.problem}; check `--hardware.joint-offset`")
            why = self.safety.refused or "the hand stopped answering; check the cable and the power"
            raise HandError(f"{self.arguments.port}: {why}")

    def _await_motors(self) -> None:
        until = time.monotonic() + _STILL
        while not self.safety.anchor:
            self._check()
            if time.monotonic() > until:
                raise HandError(f"{self.arguments.port}: the motors did not come on: {self.safety.last[1]}")
            time.sleep(0.01)

    def _approach(self) -> None:
        """Move to the start posture, and hold it until the object is seen."""
        arguments, start = self.arguments, self.safety.commanded  # Not the last reading, which may be wrong.
        goal = np.asarray(self.controller.spec.posture or start, np.float32)
        goal = goal if arguments.approach > 0 else start
        begin, pace = time.monotonic(), Pace(arguments.rate)
        ready = begin + arguments.approach + arguments.place
        objects = self._objects()
        while (now := time.monotonic()) < ready or not objects.ready():
            if now > ready + _PATIENCE:
                raise HandError(
                    "the camera does not see the object; check the light, the colour thresholds "
                    "(--optics.hsv-low, --optics.hsv-high) and --optics.min-area"
                )
            share = min((now - begin) / arguments.approach, 1.0) if arguments.approach > 0 else 1.0
            self.safety.set_target(start + np.float32(share * share * (3 - 2 * share)) * (goal - start), now)
            self._check()
            pace.wait()

    def _objects(self) -> ObjectSensors:
        assert self.objects is not None, "`prepare` opens the sensors"
        return self.objects

    def _check(self) -> None:
        if self.guard:
            self.guard.check()
        self._check_servo()
        if self.safety.latched:
            raise HandError(f"stopped: {self.safety.latched}")

    def _check_servo(self) -> None:
        if (error := self.servo.error) is not None:
            why = error if isinstance(error, HandError) else repr(error)
            raise HandError(f"the exchange thread failed: {why}")

    def _loop(self) -> str:
        anchor, self.started = self.safety.anchor, time.monotonic()
        self.outcome = Outcome(self.started)
        self.servo.forget()
        self.pace = Pace(self.controller.policy.control_rate)
        # A tick starts when a request has just been sent; rates from `keep_phase` keep it so.
        self.pace.next = self.servo.free(self.pace.next)
        while time.monotonic() < self.started + self.arguments.seconds:
            self._check()
            now, sample = time.monotonic(), self.safety.sample
            assert sample is not None, "no state yet"
            measured = now - sample.time <= self.safety.config.stale
            self.outcome.add(now, measured, self.safety)
            if measured:
                if anchor != self.safety.anchor:
                    anchor = self.safety.anchor
                    self.controller.resume(self.safety.commanded)
                self._tick(now, sample)
                self.compute.add(time.monotonic() - now)
            self.pace.wait()
        self._check()
        return "time is over"

    def _tick(self, now: float, sample: Any) -> None:
        objects = self._objects()
        seen, when = objects.read(now)
        goal = self.goals.update(when, seen) if self.goals else IDENTITY
        if self.arguments.motors_off:
            self.controller.anchor(sample.measured.joint_position)
        tick = self.controller.tick(sample.measured, seen, goal, self.arguments.command)
        self.safety.set_target(tick.target, now, objects.lost(now, self.safety.config.stale_object))
        self.tick = tick
        self.outcome.act(tick.target)
        self.force += float(sample.measured.finger_force.sum())
        self.forces += 1
        readings = {field.name: getattr(tick.readings, field.name) for field in dataclasses.fields(tick.readings)}
        self.log.add(
            Kind.TICK,
            {
                "sequence": sample.sequence,
                "age": now - sample.time,
                "readings": readings,
                "observation": tick.observation,
                "action": tick.action,
                "target": tick.target,
            },
            now,
        )

    def _tap(self, direction: str, data: bytes) -> None:
        kind = Kind.SENT if direction == "tx" else Kind.RECEIVED
        self.log.add(kind, (self.port.counts.sent, data))

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
        text = arguments.calibration.read_text() if arguments.calibration else ""
        digest = hashlib.sha256(b"".join(np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(policy.params)))
        self.log.add(
            Kind.META,
            {
                "task": policy.task,
                "spec": to_dict(policy.spec),
                "policy": arguments.policy,
                "policy_sha256": digest.hexdigest(),
                "hand": record_of(self.sensing.hand),
                "calibration": text,
                "tare": self.sensing.tare,
                "hardware": to_dict(arguments.hardware),
                "safety": to_dict(self.safety.config),
                "command": arguments.command,
                "control_rate": policy.control_rate,
                "clock": time.time(),
                "environment": cli.environment_report(),
            },
        )
