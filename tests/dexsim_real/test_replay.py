"""A run and its replay: to the last bit, and what the viewer gets."""

import contextlib
import dataclasses
import io
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("serial")
from following_hand import FollowingHand, arguments, records, rewritten, summary

from dexsim.view.__main__ import ViewArguments, open_source
from dexsim_real import replay, run
from dexsim_real.core.log import Kind, LogError

pytestmark = pytest.mark.usefixtures("jax_as_it_is")


def test_a_run_from_the_measured_pose_to_motors_off_and_its_replay(hand, tmp_path, virtual_time):
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
    assert speeds.max() < 7.0 + 1e-3
    report = summary(tmp_path)
    assert report["end"] == "time is over" and report["command"] == 0.6
    # And the version, serial number and side.
    assert report["link"]["sent"] == report["link"]["answered"] == len(commands) + 3
    # Everything is in the log: each frame, and each tick with the answer that it saw.
    assert len(records(tmp_path, Kind.RECEIVED)) == len(records(tmp_path, Kind.SENT)) == len(commands) + 3
    ticks = records(tmp_path, Kind.TICK)
    assert report["policy_jitter"]["count"] == len(ticks) == 40
    assert [tick["readings"]["command"] for tick in ticks] == [np.float32(0.6)] * len(ticks)
    for before, after in zip(ticks[:-1], ticks[1:], strict=True):
        assert after["readings"]["last_action"].tobytes() == before["action"].tobytes()
    again = replay.Replay(tmp_path / "run.log").report
    assert again["ticks"] == again["readings_same"] == again["observations_same"] == len(ticks)
    assert again["first_difference"] is None and again["damaged_bytes"] == 0
    drawn_and_taken_along(hand, tmp_path, ticks)
    shown_in_the_live_view(tmp_path, ticks)
    forged(tmp_path)
    without_ticks(tmp_path)


def drawn_and_taken_along(hand, folder, ticks):
    """Figure by finger, signals and whole observation for rerun, and what each tick read as a dataset."""
    shown, written, drawn = [], [], []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(replay, "show_rerun", lambda *parts: shown.append(parts))
        patch.setattr(replay, "check_lerobot", lambda path: None)
        patch.setattr(replay, "write_lerobot", lambda *parts: written.append(parts))
        patch.setattr("matplotlib.pyplot.close", drawn.append)
        files = {option: str(folder / f"run.{option}") for option in ("rrd", "lerobot", "plot")}
        files["plot"] += ".png"
        assert replay.main([str(folder / "run.log"), *(f"--{option}={file}" for option, file in files.items())]) == 0
    angles, targets = np.array([tick["readings"]["joint_position"] for tick in ticks]), [t["target"] for t in ticks]
    ((_, times, series, taxels, path),) = shown
    assert str(path) == files["rrd"] and len(times) == len(ticks) == len(taxels)
    np.testing.assert_array_equal(series["angle"], angles)
    whole = np.concatenate([values for name, values in series.items() if "observation/" in name], 1)
    np.testing.assert_array_equal(whole, [tick["observation"] for tick in ticks])
    assert all(len(values) == len(ticks) for values in series.values())
    ((path, _, task, (data,)),) = written
    assert str(path) == files["lerobot"] and task == "grasp"
    for name in ("joint_position", "taxel_force", "object_quat", "command"):
        np.testing.assert_array_equal(getattr(data, name), np.float32([tick["readings"][name] for tick in ticks]))
    np.testing.assert_array_equal(data.target, np.float32(targets))
    assert data.time[0] == 0 and np.all(np.diff(data.time) > 0)
    lines = np.array([line.get_ydata() for axis in drawn[0].axes[:5] for line in axis.lines])
    np.testing.assert_array_equal(lines[0::2], angles.T)
    np.testing.assert_array_equal(lines[1::2], np.transpose(targets))


def shown_in_the_live_view(folder, ticks):
    """From the time on that its slider names."""
    source, begin, limits = open_source(ViewArguments(what=str(folder / "run.log"))), SimpleNamespace(value=0.0), {}
    source.add_controls(SimpleNamespace(add_slider=lambda name, **given: limits.update(given) or begin))
    for frame, tick in zip(source.episode(), ticks, strict=True):
        np.testing.assert_array_equal(frame.snapshot.joint_position, tick["readings"]["joint_position"])
    assert frame.kinds == () and limits["max"] == pytest.approx(1.2, abs=0.2)
    begin.value = 0.3
    assert float(next(source.episode()).snapshot.seconds) == pytest.approx(0.3, abs=0.1)


def forged(folder):
    """One bit of one logged observation changed: replay must tell."""
    seen = []

    def flip(entry):
        seen.append(entry.kind)
        if entry.kind == Kind.TICK and seen.count(Kind.TICK) == 10:
            bits = entry.content["observation"].copy().view(np.uint32)
            bits[7] ^= 1
            return dataclasses.replace(entry, content=entry.content | {"observation": bits.view(np.float32)})
        return entry

    path = rewritten(folder / "run.log", folder / "flipped.log", flip)
    report = replay.Replay(path).report
    assert report["observations_same"] == report["ticks"] - 1 and report["first_difference"].startswith("tick 9 ")
    assert replay.main([str(path)]) == 1

    def broken(entry):
        tick = entry.kind == Kind.TICK
        return dataclasses.replace(entry, content=entry.content | {"readings": 1.0}) if tick else entry

    path = rewritten(folder / "run.log", folder / "broken.log", broken)
    with pytest.raises(LogError, match=f"^{path}: invalid record[^\n]*$"):
        replay.Replay(path)


def without_ticks(folder):
    """Replay must not say that all agrees where nothing is compared."""
    no_tick, out = (lambda entry: None if entry.kind == Kind.TICK else entry), io.StringIO()
    path = rewritten(folder / "run.log", folder / "without.log", no_tick)
    with contextlib.redirect_stdout(out):
        assert replay.main([str(path)]) == 1
    assert out.getvalue().splitlines()[-1] == "nothing could be compared"
