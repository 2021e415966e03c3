"""Runs of a policy on a scripted hand: whatever ends them, the motors go off."""

import contextlib
import dataclasses
import io
import math
import os
import signal
import subprocess
import sys
import threading
import time
import tty

import jax.numpy as jnp
import numpy as np
import pytest
from paths import ROOT
from rich.console import Console

pytest.importorskip("serial")
from following_hand import FollowingHand, arguments, records, summary

from dexsim.core import cli
from dexsim.core.config import to_dict
from dexsim.core.errors import DexsimError
from dexsim.observation import layout
from dexsim.task_spec import TaskSpec
from dexsim.tasks.rotate.config import RotateConfig
from dexsim.tasks.rotate.task import Rotate
from dexsim_ppo.acting import PolicyParams
from dexsim_ppo.learner.networks import Layer
from dexsim_ppo.learner.running_stats import Normalizer
from dexsim_ppo.policy import Policy
from dexsim_real.control.controller import Controller
from dexsim_real.core.errors import HandError
from dexsim_real.core.log import Kind, LogReader
from dexsim_real.replay import replay
from dexsim_real.run import __main__ as run
from dexsim_real.run import status
from dexsim_real.sensors import imu
from dexsim_real.wire.frames import Mode

pytestmark = pytest.mark.usefixtures("jax_as_it_is")


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
        "thumb_bend 30, tip of the thumb 0, palm 0 degC",
        "ring 0.0, pinky 0.0 N, sum 0.0 N",
        "errors none",
        "end: time is over",
        "policy jitter",
    ):
        assert text in shown, text


def test_the_live_table(monkeypatch):
    monkeypatch.setenv("TERM", "xterm")
    shown = io.StringIO()
    console = Console(file=shown, force_terminal=True, width=80)
    monkeypatch.setattr(status, "Console", lambda **options: console)
    monkeypatch.setattr(status, "_LIVE", 0.02)
    with status.StatusView("a title", lambda: status.Status({"age": "3.1 ms", "command": "0.6"})) as live:
        live.note("something happened")
        time.sleep(0.2)
    for text in ("a title", "age", "3.1 ms", "something happened"):
        assert text in shown.getvalue()


@pytest.mark.parametrize("gone", ["window", "pipe"])
def test_a_terminal_that_is_gone_ends_no_run(monkeypatch, gone):
    """An SSH connection that broke, a `tee` that Ctrl-C ended: with Rich alone the exchange thread would end."""
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr(status, "_LIVE", 0.02)
    far, near = os.openpty() if gone == "window" else os.pipe()
    screen = os.fdopen(near, "w", buffering=1)
    monkeypatch.setattr("sys.stderr", screen)
    view = status.StatusView("a title", lambda: status.Status({"age": "3.1 ms"}))
    os.close(far)
    try:
        view.note("before")
        view.show()
        with pytest.raises(SystemExit, match="129"), view:
            time.sleep(0.1)
            raise SystemExit(129)
        view.note("end")
    finally:
        with open(os.devnull, "w") as nowhere:
            os.dup2(nowhere.fileno(), near)  # What the stream still holds can be written now.
        screen.close()


def test_text_in_brackets_is_shown_as_it_is(monkeypatch):
    """Such as a driver's error that names its port: to Rich it is markup, or an error."""
    text, shown = "cannot open [/dev/ttyUSB0] [bold]", io.StringIO()
    console = Console(file=shown, width=200)
    monkeypatch.setattr(status, "Console", lambda **options: console)
    status.StatusView(f"view {text}", lambda: status.Status({"safety": f"row {text}"})).show()
    status.show_summary(f"title {text}", {"end": f"cell {text}"})
    for where in ("view", "row", "title", "cell"):
        assert f"{where} {text}" in shown.getvalue()


def test_a_summary_that_cannot_be_written_is_refused_before_the_run(tmp_path):
    options = ["--port", "none", "--uncalibrated", "--yes", "--log", str(tmp_path / "run.log")]
    with pytest.raises(IsADirectoryError, match=str(tmp_path)):
        run.main(["grasp", *options, "--output", str(tmp_path)])
    with pytest.raises(DexsimError, match="--output .*run.log: is the file of --log, too"):
        run.main(["grasp", *options, "--output", str(tmp_path / "run.log")])
    assert not (tmp_path / "run.log").exists()


@pytest.mark.slow
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
            assert run.main(options) == 1
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


def test_a_hot_hand_is_relaxed_and_the_run_ends(tmp_path, capsys):
    def heat(index, state):
        state["joint"]["temperature"] = 30 if index < 100 else 95

    with FollowingHand(heat) as peer:
        assert run.main(arguments(peer, tmp_path, "--seconds", "5")) == 1
        hot = peer.times[100]
        assert not peer.on()[np.array(peer.times) > hot + 0.3].any()
    end = summary(tmp_path)["end"]
    assert "too hot: joint thumb_bend (thumb), 95 degC" in end
    assert capsys.readouterr().err == f"error: {end}\n", "also with --quiet"


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
                    "--yes",
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
                    "--yes",
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


@pytest.mark.parametrize(
    "number", [signal.SIGTERM, signal.SIGINT, signal.SIGQUIT, signal.SIGHUP, signal.SIGTSTP, signal.SIGKILL]
)
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
        # Without a guard nobody is left to relax it. The log is whole.
        assert code == -9
        ticks = [record.time for record in LogReader(tmp_path / "run.log") if record.kind == Kind.TICK]
        assert sent - ticks[-1] < 1.0
        assert replay.replay(tmp_path / "run.log").report["ended"] == "truncated"
    else:
        assert code == (130 if number == signal.SIGINT else 128 + number)
        assert not on[-1] and not on[np.array(peer.times) > sent + 0.5].any()
        assert ("Ctrl-C" if number == signal.SIGINT else f"signal {int(number)}") in records(tmp_path, Kind.END)[0][
            "end"
        ]


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
            start = time.monotonic() if start is None and len(peer.commands) > 130 and sessions else start
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
