"""The bridge as a whole: the simulation's door and the hand's give the same observation in the same order, and a
run ends with the motors off, however it ends."""

import contextlib
import dataclasses
import io
import json
import math
import os
import signal
import subprocess
import sys
import threading
import time
import tty
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from paths import ROOT
from pty_hand import PtyHand
from rich.console import Console

pytest.importorskip("serial")

from dexsim.control import Control
from dexsim.core import cli
from dexsim.core.config import to_dict
from dexsim.env.env import Env
from dexsim.env.state import Start
from dexsim.geometry import rotations
from dexsim.observation import layout
from dexsim.physics.seam import PhysicsState
from dexsim.randomization import Randomization
from dexsim.sensing.config import Sensing
from dexsim.sensing.imu import OrientationSensor
from dexsim.sensing.taxel_reading import TaxelSensor
from dexsim.task_spec import TaskSpec
from dexsim.tasks.grasp.config import GraspConfig
from dexsim.tasks.grasp.task import Grasp
from dexsim.tasks.rotate.config import RotateConfig
from dexsim.tasks.rotate.objects import sample_target
from dexsim.tasks.rotate.task import Rotate
from dexsim_ppo.learner.networks import Layer
from dexsim_ppo.learner.running_stats import Normalizer
from dexsim_ppo.policy import Policy, PolicyParams, load_policy
from dexsim_real.control.controller import IDENTITY, Controller
from dexsim_real.core.errors import HandError
from dexsim_real.core.log import Kind, LogError, LogReader
from dexsim_real.replay import __main__ as replay_command
from dexsim_real.replay import replay
from dexsim_real.replay.plots import show_rerun
from dexsim_real.run import __main__ as run
from dexsim_real.run import status
from dexsim_real.sensors import imu
from dexsim_real.sensors.hand import HandSensing, HardwareConfig
from dexsim_real.sensors.readings import ObjectEstimate
from dexsim_real.wire import frames
from dexsim_real.wire.frames import Mode

QUIET = Sensing(
    joint_noise=0.0,
    joint_resolution=0.0,
    torque_noise=0.0,
    object_noise=0.0,
    orientation=OrientationSensor(noise=0.0, bias=0.0, drift=0.0, delay=(0.0, 0.0), rate=10000.0),
    taxel=TaxelSensor(noise=0.0),
)


class FakePhysics:
    """Joints that follow torque like a first-order lag and an object that turns: `Env` around it is the real one."""

    def __init__(self, hand, slots, largest, config, **options):
        self.backend, self.config = "jax", config
        self.joint_qpos, self.joint_dof = np.arange(12), np.arange(12)
        self.object_qpos, self.object_dof = np.arange(12, 19), np.arange(12, 18)
        self.mj_model = SimpleNamespace(nv=18, dof_M0=np.ones(18), opt=SimpleNamespace(timestep=config.timestep))

    def advance(self, target, state, torque, push):
        joints, velocity = state.qpos[:12], state.qvel[:12]
        velocity = torque(jnp.asarray(5), joints, velocity) * 2.0
        joints = joints + self.config.control_period * velocity
        turned = rotations.quat_multiply(jnp.array([jnp.cos(0.02), jnp.sin(0.02), 0.0, 0.0]), state.qpos[15:])
        qpos = jnp.concatenate([joints, state.qpos[12:15], turned])
        qvel = jnp.concatenate([velocity, jnp.zeros(6)])
        force = jnp.zeros((5, 3)).at[:, 0].set(jnp.abs(jnp.sin(5 * joints[:5])) * 3)
        return PhysicsState(qpos, qvel, state.warmstart), force


class StillRotate(Rotate):
    """The task, but with one start state made on the spot."""

    def make_pool(self, key):
        place = jnp.concatenate([jnp.asarray(self.reference), jnp.array([1.0, 0, 0, 0])])
        qpos = jnp.concatenate([jnp.asarray(self.config.posture), place])
        target = sample_target(key, self.config)
        return jax.tree.map(lambda x: x[None], Start(qpos, jnp.zeros(18), target))


class Acts:
    """What the controller needs of a policy, with a function in place of the network."""

    def __init__(self, task, hand, act):
        config = task.config
        self.act, self.task, self.spec = act, task.name, TaskSpec.of(task)
        self.control_rate = 1 / config.physics.control_period
        self.observation_layout = layout(hand, task.fields["actor"], config.observation)

    def __call__(self, observation):
        return self.act(observation)


def random_state(rng, hand):
    """A state block with every number different and few taxels pressed."""
    block = frames.empty_state()
    block["joint"]["position"] = rng.uniform(hand.joint_lower, hand.joint_upper)
    block["joint"]["current"] = rng.integers(-900, 900, 12)
    block["tip"]["taxel"]["z"] = rng.integers(0, 60, (5, 120)) * (rng.random((5, 120)) < 0.1)
    return block


@pytest.mark.parametrize(("task_class", "config"), [(Grasp, GraspConfig()), (Rotate, RotateConfig())])
def test_one_frame_gives_the_same_observation_through_both_doors_bit_for_bit(hand, task_class, config):
    rng = np.random.default_rng(4)
    task = task_class(config, hand)
    controller = Controller(Acts(task, hand, lambda observation: rng.uniform(-1, 1, 12).astype(np.float32)), hand)
    sensing = HandSensing(hand, HardwareConfig())
    # The simulation's door: `Env._observe`, compiled by itself, on readings and some truth for the critic.
    env = object.__new__(Env)
    env.task, env.hand, env.config = task, hand, config
    env._seen = dict.fromkeys(task.fields, config.observation)

    def door(readings, goal):
        moment = SimpleNamespace(
            **dict.fromkeys(("joint_torque", "joint_velocity", "action"), jnp.zeros(12)),
            joint_position=readings.joint_position,
            touch=SimpleNamespace(force=readings.taxel_force),
            object_position=readings.object_position,
            object_velocity=readings.object_velocity,
            object_quat=readings.object_quat,
            object_spin=jnp.zeros(3),
        )
        return env._observe(readings, moment, goal)["actor"]

    door = jax.jit(door)
    goal = task.begin(jax.random.key(0), None)
    for _ in range(20):
        quats = rng.normal(size=(2, 4))
        quats /= np.linalg.norm(quats, axis=1, keepdims=True)
        seen = ObjectEstimate(rng.normal(size=3), rng.normal(size=3), quats[0])
        data = random_state(rng, hand).tobytes()
        tick = controller.tick(sensing.measure(frames.decode_state(data)), seen, quats[1], 0.37)
        simulated = np.asarray(door(tick.readings, goal))
        assert simulated.dtype == tick.observation.dtype == np.float32
        assert simulated.tobytes() == tick.observation.tobytes()
        assert len(simulated) == (66 if task.name == "grasp" else 65)


def test_a_golden_trace_pins_the_order_of_action_and_sensing(hand, monkeypatch):
    """The real `Env.step` over simple physics, and the bridge fed with frames of what that hand measured."""
    monkeypatch.setattr("dexsim.env.env.Physics", FakePhysics)
    config = RotateConfig(
        sensing=QUIET,
        randomization=Randomization(scale=0.0),
        pool_size=1,
        edge=(0.11, 0.11),
        control=Control(step=0.08),
    )
    task = StillRotate(config, hand)
    weights = np.random.default_rng(0).normal(size=(65, 12)).astype(np.float32) * 0.3

    def act(observation):
        return jnp.tanh(jnp.asarray(observation) @ weights)

    env = Env(task, hand)
    state, step = jax.jit(env.reset)(jax.random.key(3)), jax.jit(env.step)
    controller = Controller(Acts(task, hand, act), hand)
    controller.start(np.asarray(state.joint_target))
    sensing = HandSensing(hand, HardwareConfig(taxel_floor=0.0))
    at = [f.name for f in controller.policy.observation_layout].index("last_action")
    begin = sum(f.size for f in controller.policy.observation_layout[:at])
    actions, touched = [np.zeros(12, np.float32)], 0
    for _ in range(10):
        readings = state.readings
        block = frames.empty_state()
        block["joint"]["position"] = readings.joint_position
        block["tip"]["taxel"]["z"] = np.round(np.asarray(readings.taxel_force) / 0.1)
        seen = ObjectEstimate(readings.object_position, readings.object_velocity, readings.object_quat)
        tick = controller.tick(sensing.measure(block), seen, readings.goal_quat, 0.0)
        # The action in the observation is the one that led to this measurement, not the one it leads to.
        np.testing.assert_array_equal(tick.observation[begin : begin + 12], actions[-1])
        np.testing.assert_array_equal(tick.readings.last_action, actions[-1])
        np.testing.assert_allclose(tick.readings.last_action, readings.last_action, atol=1e-5)
        np.testing.assert_allclose(tick.observation, state.obs["actor"], atol=2e-5)
        actions.append(tick.action)
        touched += bool(np.any(readings.taxel_force))
        state = step(state, act(state.obs["actor"]))
        np.testing.assert_allclose(tick.target, state.joint_target, atol=1e-5)
        np.testing.assert_allclose(tick.action, state.action, atol=1e-5)
    assert np.abs(np.diff(actions, axis=0)).max() > 0.05 and touched > 4


def test_an_action_that_is_not_finite_counts_as_none(hand):
    task = Grasp(GraspConfig(), hand)
    answers = iter([np.full(12, 0.5, np.float32), np.full(12, np.nan, np.float32), np.full(12, 3.0, np.float32)])
    controller = Controller(Acts(task, hand, lambda observation: next(answers)), hand)
    middle = ((hand.joint_lower + hand.joint_upper) / 2).astype(np.float32)
    controller.start(middle)
    block = frames.empty_state()
    block["joint"]["position"] = middle
    measured = HandSensing(hand, HardwareConfig()).measure(block)
    seen = ObjectEstimate(np.zeros(3), np.zeros(3), IDENTITY)
    first, second, third = (controller.tick(measured, seen, IDENTITY, 0.5) for _ in range(3))
    assert np.isnan(second.target).all() and not second.action.any()
    np.testing.assert_array_equal(third.readings.last_action, np.zeros(12))
    np.testing.assert_array_equal(third.action, np.ones(12))  # Clipped, as `Env.step` does.
    inside = np.abs(middle - hand.joint_upper) > 0.4
    np.testing.assert_allclose((third.target - first.target)[inside], 0.2, atol=1e-5)


# --- runs ----------------------------------------------------------------------------------------


@pytest.fixture(autouse=True)
def jax_as_it_is(monkeypatch):
    """Runs within the tests' process leave the flags that other tests compile with alone."""
    monkeypatch.setattr(run, "prepare_jax", lambda: None)
    monkeypatch.setattr(replay_command, "prepare_jax", lambda: None)


class FollowingHand(PtyHand):
    """Joints that go a third of the way to their target at each exchange; it keeps what was asked of it."""

    def __init__(self, trouble=None, pause=0.0):
        super().__init__(self._follow)
        self.trouble, self.pause = trouble or (lambda index, state: None), pause
        self.times, self.poses = [], []
        self.state["joint"]["position"] = 0.1
        self.state["joint"]["position"][3] = 0.0

    def _follow(self, index, block, state):
        time.sleep(self.pause)
        joint = state["joint"]
        self.times.append(time.monotonic())
        self.poses.append(joint["position"].copy())
        on = block["mode"] == Mode.POSITION
        joint["position"] += np.where(on, (block["position"] - joint["position"]) / 3, 0)
        return self.trouble(index, state)

    def on(self):
        """Whether the motors were on, by exchange."""
        return np.array([bool(np.all(block["mode"] == Mode.POSITION)) for block in self.commands])


def arguments(peer, folder, *more):
    """Patient with the peer, which shares this process and perhaps a busy machine."""
    return [
        "grasp",
        "--port",
        peer.port,
        "--uncalibrated",
        "--fixed-object",
        "--link.settle",
        "0",
        "--link.no-paced",
        "--link.margin",
        "0.2",
        "--safety.stale",
        "1",
        "--approach",
        "0.4",
        "--log",
        str(folder / "run.log"),
        "--output",
        str(folder / "run.json"),
        "--quiet",
        "--no-realtime",
        *more,
    ]


def summary(folder):
    return json.loads((folder / "run.json").read_text())


def records(folder, kind):
    return [record.content for record in LogReader(folder / "run.log") if record.kind == kind]


def test_a_run_from_the_measured_pose_to_motors_off_and_its_replay(hand, tmp_path):
    with FollowingHand() as peer:
        assert run.main(arguments(peer, tmp_path, "--seconds", "1.2", "--command", "0.6")) == 0
        on, commands = peer.on(), peer.commands
    first = int(np.argmax(on))
    # Off while zeroing and warming, on at the measured pose, without a break until the end, then off.
    assert first > 30 and on[first:-1].all() and not on[-1]
    np.testing.assert_allclose(commands[first]["position"], peer.poses[first], atol=1e-6)
    sent = np.array([block["position"] for block, motor in zip(commands, on, strict=True) if motor])
    assert np.all(sent >= hand.joint_lower - 1e-6) and np.all(sent <= hand.joint_upper + 1e-6)
    speeds = np.abs(np.diff(sent, axis=0)).max(1) / np.diff(np.array(peer.times)[on])
    assert np.median(speeds) < 25
    report = summary(tmp_path)
    assert report["end"] == "time is over" and report["command"] == 0.6
    assert report["policy_jitter"]["count"] == pytest.approx(1.2 * 100 / 3, abs=15)
    assert report["link"]["sent"] == report["link"]["answered"] == len(commands) + 1  # And the version.
    # Everything is in the log: each frame, and each tick with the frame that it saw.
    assert len(records(tmp_path, Kind.RECEIVED)) == len(records(tmp_path, Kind.SENT)) == len(commands) + 1
    ticks = records(tmp_path, Kind.TICK)
    assert [tick["readings"]["command"] for tick in ticks] == [np.float32(0.6)] * len(ticks)
    for before, after in zip(ticks[:-1], ticks[1:], strict=True):
        assert after["readings"]["last_action"].tobytes() == before["action"].tobytes()
    again = replay.replay(tmp_path / "run.log").report
    assert again["ticks"] == again["readings_same"] == again["observations_same"] == len(ticks) > 20
    assert again["first_difference"] is None and again["damaged_bytes"] == 0
    assert replay_command.main([str(tmp_path / "run.log"), "--plot", str(tmp_path / "run.png")]) == 0
    assert (tmp_path / "run.png").stat().st_size > 10_000
    forged(tmp_path)
    seen_in_rerun(tmp_path)


class Rerun:
    """Stands in for the rerun package, which is an extra of 170 MB: keeps what is sent to the viewer."""

    class RecordingStream:
        def __init__(self, name):
            self.columns, self.pictures, self.names, self.saved = {}, [], {}, None
            Rerun.last = self

        def save(self, path):
            self.saved = path

        def set_time(self, timeline, duration):
            self.now = duration

        def log(self, entity, what, static=False):
            self.names.update({entity: what}) if static else self.pictures.append((self.now, entity, what))

        def send_columns(self, entity, indexes, columns):
            self.columns[entity] = indexes[0], columns

        def disconnect(self):
            pass

    class Scalars:
        @staticmethod
        def columns(scalars):
            return scalars

    @staticmethod
    def SeriesLines(names):
        return names

    @staticmethod
    def TimeColumn(timeline, duration):
        return duration

    @staticmethod
    def DepthImage(picture, **_):
        return picture


def seen_in_rerun(folder):
    """What goes to the viewer is what the log says, under the names of joints, fingers and fields."""
    path = folder / "run.log"
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, "rerun", None)
        with pytest.raises(LogError, match=r"pip install 'dexsim\[rerun\]'"):
            show_rerun(replay.replay(path), folder / "run.rrd")
        patch.setitem(sys.modules, "rerun", Rerun)
        assert replay_command.main([str(path), "--rrd", str(folder / "new" / "run.rrd")]) == 0
    sent, ticks = Rerun.last, records(folder, Kind.TICK)
    assert sent.saved == folder / "new" / "run.rrd"
    for entity, key in (("angle", "joint_position"), ("observation/joint_position", "joint_position")):
        np.testing.assert_array_equal(sent.columns[entity][1], [tick["readings"][key] for tick in ticks])
    whole = np.concatenate([values for entity, (_, values) in sent.columns.items() if "observation/" in entity], 1)
    np.testing.assert_array_equal(whole, [tick["observation"] for tick in ticks])
    for entity, (times, values) in sent.columns.items():
        assert values.shape == (len(times), len(sent.names[entity])) and len(times) == len(ticks), entity
        assert times[0] == 0 and np.all(np.diff(times) > 0)
    assert len(sent.pictures) == 5 * len(ticks) and {picture.shape for *_, picture in sent.pictures} == {(12, 10)}


def test_the_real_viewer_takes_a_replay(tmp_path):
    """Not in the suite's environment: `pip install rerun-sdk` first."""
    pytest.importorskip("rerun")
    with FollowingHand() as peer:
        assert run.main(arguments(peer, tmp_path, "--seconds", "0.5")) == 0
    assert replay_command.main([str(tmp_path / "run.log"), "--rrd", str(tmp_path / "run.rrd")]) == 0
    assert (tmp_path / "run.rrd").read_bytes()[:3] == b"RRF"


def forged(folder):
    """One bit of one logged observation changed: replay must tell."""
    from dexsim_real.core.log import LogWriter

    path = folder / "forged.log"
    with LogWriter(path) as log:
        seen = 0
        for record in LogReader(folder / "run.log"):
            content = record.content
            if record.kind == Kind.TICK:
                seen += 1
                if seen == 10:
                    bits = content["observation"].copy().view(np.uint32)
                    bits[7] ^= 1
                    content = {**content, "observation": bits.view(np.float32)}
            log.add(record.kind, content, record.time)
    report = replay.replay(path).report
    assert report["observations_same"] == report["ticks"] - 1 and report["first_difference"].startswith("tick 9 ")
    assert replay_command.main([str(path)]) == 1


def test_motors_off_means_off_and_the_view_says_what_is_read(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(status, "_LINES", 0.25)
    with FollowingHand() as peer:
        options = [o for o in arguments(peer, tmp_path, "--seconds", "0.9", "--motors-off") if o != "--quiet"]
        assert run.main(options) == 0
        assert not peer.on().any()
    assert len(records(tmp_path, Kind.TICK)) >= 15
    shown = capsys.readouterr().err
    for text in (
        "firmware 1.3.9",
        "the policy starts",
        "policy 33.3 Hz",
        "exchanges 83.3 Hz",
        "0 corrupt",
        "joints 30",
        "sum 0.0 N",
        "end: time is over",
        "policy jitter",
    ):
        assert text in shown, text


def test_the_live_table(monkeypatch):
    shown = io.StringIO()
    console = Console(file=shown, force_terminal=True, width=80)
    monkeypatch.setattr(status, "Console", lambda **options: console)
    monkeypatch.setattr(status, "_LIVE", 0.02)
    with status.StatusView("a title", lambda: {"age": "3.1 ms", "force": "1.0 N"}) as live:
        live.note("something happened")
        time.sleep(0.2)
    for text in ("a title", "age", "3.1 ms", "something happened"):
        assert text in shown.getvalue()


@pytest.mark.parametrize(("failure", "reaction"), [("raises", None), ("hangs", "no target"), ("nan", "not finite")])
def test_a_policy_that_dies_leaves_the_hand_safe(tmp_path, monkeypatch, failure, reaction):
    real, count = Controller.tick, iter(range(10**6))
    died = []

    def tick(self, *inputs):
        if next(count) > 15 and self.spec is not None:
            died.append(time.monotonic())
            if failure == "raises":
                raise RuntimeError("the policy broke")
            if failure == "hangs" and len(died) == 1:
                time.sleep(1.6)
            result = real(self, *inputs)
            return dataclasses.replace(result, target=np.full(12, np.nan)) if failure == "nan" else result
        return real(self, *inputs)

    monkeypatch.setattr(Controller, "tick", tick)
    with FollowingHand() as peer:
        options = arguments(peer, tmp_path, "--seconds", "2.0" if failure == "hangs" else "1.0")
        if failure == "raises":
            with pytest.raises(RuntimeError, match="the policy broke"):
                run.main(options)
        else:
            assert run.main(options) == (1 if failure == "hangs" else 0)
        on, times = peer.on(), np.array(peer.times)
        assert not on[-1] and on.any()
        positions = np.array([block["position"] for block in peer.commands])
        after = positions[on & (times > died[0] + 0.12)]
        # Whatever was still sent with motors on after 100 ms was one and the same pose.
        assert np.abs(after - after[:1]).max(initial=0.0) < 1e-6
    if reaction:
        notes = records(tmp_path, Kind.NOTE)
        assert any(note.startswith("hold") and reaction in note for note in notes)
    assert records(tmp_path, Kind.END)


def test_a_hot_hand_is_relaxed_and_the_run_ends(tmp_path):
    def heat(index, state):
        state["joint"]["temperature"] = 30 if index < 100 else 95

    with FollowingHand(heat) as peer:
        assert run.main(arguments(peer, tmp_path, "--seconds", "5")) == 1
        hot = peer.times[100]
        assert not peer.on()[np.array(peer.times) > hot + 0.3].any()
    assert "too hot: 95 degC" in summary(tmp_path)["end"]


def test_a_line_full_of_faults_does_not_end_the_run(hand, tmp_path):
    rng = np.random.default_rng(1)
    faults = []

    def trouble(index, state):
        if index < 60 or rng.random() > 0.1:
            return None
        faults.append(index)
        whole = bytearray(peer.whole())
        if rng.random() < 0.5:
            whole[int(rng.integers(len(whole)))] ^= 1 << int(rng.integers(8))
        else:
            del whole[int(rng.integers(len(whole))) :]
        return bytes(whole)

    with FollowingHand(trouble) as peer:
        assert run.main(arguments(peer, tmp_path, "--seconds", "1.5", "--link.margin", "0.06")) == 0
        sent = np.array([block["position"] for block in peer.commands])[peer.on()]
    assert np.all(sent >= hand.joint_lower - 1e-6) and np.all(sent <= hand.joint_upper + 1e-6)
    link = summary(tmp_path)["link"]
    # On a busy machine the peer itself may be late.
    assert link["corrupt"] + link["silent"] == len(faults) + link["late"] > 5
    assert replay.replay(tmp_path / "run.log").report["first_difference"] is None


def test_what_is_missing_is_said_in_one_line(tmp_path, capsys):
    with FollowingHand() as peer:
        for options, message in (
            (["grasp", "--port", peer.port], "--calibration"),
            (
                [
                    "grasp",
                    "--port",
                    str(tmp_path / "none"),
                    "--uncalibrated",
                    "--fixed-object",
                    "--quiet",
                    "--log",
                    str(tmp_path / "a.log"),
                ],
                "there is no such port",
            ),
            (
                [
                    "grasp",
                    "--port",
                    peer.port,
                    "--uncalibrated",
                    "--quiet",
                    "--link.settle",
                    "0",
                    "--link.no-paced",
                    "--log",
                    str(tmp_path / "b.log"),
                ],
                "--camera, or --fixed-object",
            ),
            (["grasp", "--port", peer.port, "--uncalibrated", "--calibration", "x.toml"], "not both"),
            (["grasp", "--port", peer.port, "--uncalibrated", "--command", "1.5"], "between 0 and 1"),
        ):
            with pytest.raises(SystemExit) as stop:
                cli.run(lambda _, options=options: run.main(options))
            error = capsys.readouterr().err.strip().splitlines()[-1]
            assert stop.value.code == 2 and error.startswith("error: ") and message in error
        assert not peer.on().any()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGKILL])
def test_signals(tmp_path, number):
    with FollowingHand() as peer:
        command = [sys.executable, "-m", "dexsim_real.run", *arguments(peer, tmp_path, "--seconds", "60")]
        # As a shell starts what runs in the background: with Ctrl-C ignored.
        process = subprocess.Popen(
            ["sh", "-c", "trap '' INT; exec \"$@\"", "sh", *command], cwd=ROOT, stderr=subprocess.PIPE
        )
        try:
            until = time.monotonic() + 60
            while peer.on().sum() < 60 and process.poll() is None and time.monotonic() < until:
                time.sleep(0.05)
            sent = time.monotonic()
            process.send_signal(number)
            code = process.wait(20)
        finally:
            process.kill()
        time.sleep(0.1)
        on = peer.on()
    if number == signal.SIGKILL:
        # Nobody is left to relax it: that is for the hand's own watchdog. The log is whole.
        assert code == -9
        ticks = [record.time for record in LogReader(tmp_path / "run.log") if record.kind == Kind.TICK]
        assert sent - ticks[-1] < 1.0
        assert replay.replay(tmp_path / "run.log").report["ended"] == "truncated"
    else:
        assert code == (143 if number == signal.SIGTERM else 130)
        assert not on[-1] and not on[np.array(peer.times) > sent + 0.5].any()
        assert ("signal 15" if number == signal.SIGTERM else "Ctrl-C") in records(tmp_path, Kind.END)[0]["end"]


def test_running_a_policy_needs_no_mjx(tmp_path):
    code = """
import sys
from dexsim import load_hand
from dexsim_ppo.evaluate import load_policy
from dexsim_real import run, replay
from dexsim_real.control.controller import Controller
Controller(load_policy("grasp"), load_hand()).warm()
print([name for name in sys.modules if "mjx" in name or name in ("warp", "brax", "cv2", "serial")])
"""
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=120,
        env={**os.environ, "JAX_PLATFORMS": "cpu"},
    )
    assert done.stdout.strip() == "[]", done.stderr


def test_the_shipped_policy_fits_the_bridge(hand):
    controller = Controller(load_policy("grasp"), hand)
    assert controller.sources == {"hand", "camera", "user"} and controller.period == pytest.approx(0.03)


def rotate_policy(hand, path):
    """A policy file of the rotation task with small random weights."""
    config = RotateConfig(tilt=0.0, roll=0.0)
    fields = layout(hand, Rotate.fields["actor"], config.observation)
    size = sum(field.size for field in fields)
    rng = np.random.default_rng(0)
    params = PolicyParams(
        (Layer(jnp.asarray(0.05 * rng.normal(size=(size, 12)), jnp.float32), jnp.zeros(12)),),
        Normalizer(jnp.zeros(size), jnp.ones(size)),
    )
    Policy(
        task="rotate",
        env_config=to_dict(config),
        observation_layout=fields,
        params=params,
        control_rate=1 / config.physics.control_period,
        spec=TaskSpec.of(Rotate(config, hand)),
    ).save(path)


def test_a_rotation_policy_with_an_imu_counts_goals(hand, tmp_path):
    """The object turns by 70 degrees a second about the palm's normal, as its IMU says."""
    rotate_policy(hand, tmp_path / "turn.msgpack")
    master, slave = os.openpty()
    tty.setraw(slave)
    os.set_blocking(master, False)
    stop, begin = threading.Event(), []

    def turn():
        index, start = 0, None
        while not stop.wait(0.01):
            sessions = [block for block in peer.commands[-1:] if np.all(block["mode"] == Mode.POSITION)]
            start = time.monotonic() if start is None and len(peer.commands) > 110 and sessions else start
            angle = 0.0 if start is None else math.radians(70) * (time.monotonic() - start)
            # The part's z is up, and its heading unknown. Nobody may be reading yet.
            with contextlib.suppress(BlockingIOError):
                os.write(master, imu.encode(index, np.array([math.cos(angle / 2 + 1), 0, 0, math.sin(angle / 2 + 1)])))
            index += 1
        begin.append(start)

    with FollowingHand() as peer:
        thread = threading.Thread(target=turn, daemon=True)
        thread.start()
        options = [str(tmp_path / "turn.msgpack"), *arguments(peer, tmp_path, "--seconds", "4")[1:]]
        with pytest.raises(HandError, match="give the IMU's port with --imu"):
            run.main([options[0], *arguments(peer, tmp_path / "without")[1:]])
        peer.commands.clear()
        assert run.main([*options, "--imu", os.ttyname(slave)]) == 0
        stop.set()
        thread.join()
    os.close(master)
    os.close(slave)
    ticks, report = records(tmp_path, Kind.TICK), summary(tmp_path)
    # 280 degrees less the start: a success at 73 and 163, and perhaps at 253.
    assert begin[0] is not None and report["successes"] in (2, 3)
    quats = np.array([tick["readings"]["object_quat"] for tick in ticks])
    turned = 2 * np.unwrap(np.arctan2(quats[:, 1], quats[:, 0]))
    assert abs(turned[0]) < 0.2 and np.abs(quats[:, 2:]).max() < 1e-3
    assert np.all(np.diff(turned) > -1e-3) and turned[-1] > math.radians(170)
    goals = np.array([tick["readings"]["goal_quat"] for tick in ticks])
    assert len(np.unique(goals, axis=0)) == report["successes"] + 1
    again = replay.replay(tmp_path / "run.log").report
    assert again["observations_same"] == again["ticks"] == len(ticks) > 80
