"""A calibration file from anywhere: what no hand gives is refused in one line, in bounded time and memory."""

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dexsim.calibration.maps import (
    Calibration,
    Side,
    calibrated_hand,
    load_calibration,
    normalised_torque,
    save_calibration,
    taxel_force,
)
from dexsim.core.errors import CalibrationError


def side(gain, offset, largest):
    pair = np.ones((2, 12))
    lines = [pair * gain, pair * gain, pair * gain, pair * offset, pair * offset, pair * offset]
    return Side(
        *lines, 0.01 * pair, pair, 5 * pair, 50 * pair, 0 * pair, *(np.ones(12) * v for v in (0.02, largest, 8.0))
    )


@pytest.fixture(scope="module")
def sound(hand, tmp_path_factory):
    """The text of a file like the XHand's: 0.8 Nm/A at levers of 4 cm."""
    calibration = Calibration(
        side(-0.05, 0.02, 0.5),
        side(0.04, 0.001, 0.3),
        hand.torque_limit,
        np.full(5, 0.1),
        hand=hand.name,
        joint_names=hand.joint_names,
        finger_names=hand.finger_names,
        notes=("pressed on Monday",),
        force_per_torque=np.array([[12.0] * 5, [11.0] * 5, [13.0] * 5]),
    )
    path = tmp_path_factory.mktemp("sound") / "c.toml"
    save_calibration(path, calibration)
    load_calibration(path, hand)
    return path.read_text()


def refused(path, hand, text):
    """The one line that refuses a file."""
    path.write_bytes(text.encode("utf-8", "surrogateescape"))
    with pytest.raises(CalibrationError) as caught:
        load_calibration(path, hand)
    line = str(caught.value)
    assert line.startswith(f"{path}: ") and "\n" not in line and len(line) < len(str(path)) + 250
    return line.removeprefix(f"{path}: ")


PAIR = "gain = [-0.05, -0.05]"
WRONG = {
    "a torque for no current": ((PAIR, "gain = [-1e-9, -1e-9]"), "thumb_bend: real.gain = -1e-09: .* need 2.75e-08 A"),
    "no torque for any current": ((PAIR, "gain = [-1e9, -1e9]"), "thumb_bend: real.gain = -1e.09: .* need 2.75e.10 A"),
    "two signs": ((PAIR, "gain = [-0.05, 0.05]"), "thumb_bend: real.gain = 0.05: .* of one sign"),
    "a gain of 0": ((PAIR, "gain = [0.0, 0.0]"), "thumb_bend: real.gain = 0: .* not 0"),
    "a gain that is no number": ((PAIR, "gain = [nan, nan]"), "thumb_bend: real.gain = nan: must be finite"),
    "a huge whole number": ((PAIR, f"gain = [{10**400}, 1]"), "'gain' holds a number without bounds"),
    "a lever of a metre": (("gain = [0.04, 0.04]", "gain = [1.0, 1.0]"), "thumb_bend: sim.gain = 1: .* 0.3 Nm/N"),
    "torque at rest": (
        ("offset = [0.02, 0.02]", "offset = [5.0, 5.0]"),
        "thumb_bend: real.offset = 5: without current",
    ),
    "the opposite torque at rest": (
        ("offset = [0.02, 0.02]", "offset = [-5.0, -5.0]"),
        "thumb_bend: real.offset = -5: without current",
    ),
    "an endless offset": (("offset = [0.02, 0.02]", "offset = [inf, inf]"), "thumb_bend: real.offset = inf: "),
    "another torque": (
        ("torque_scale = 1.1", "torque_scale = 0.9"),
        "thumb_bend: torque_scale = 0.9: not the torque limit",
    ),
    "a negative torque": (("torque_scale = 1.1", "torque_scale = -1.1"), "thumb_bend: torque_scale = -1.1: must be"),
    "a press of 1,000 N": (("force_max = 8.0", "force_max = 1000.0"), "thumb_bend: real.force_max = 1000: .* 100 N"),
    "a press of 0 N": (("force_max = 8.0", "force_max = 0"), "thumb_bend: real.force_max = 0: "),
    "a current of 100 A": (
        ("value_max = 0.5", "value_max = 100.0"),
        "thumb_bend: real.value_max = 100: .* at most 33 A",
    ),
    "endless noise": (("noise = [0.01, 0.01]", "noise = [inf, 0.01]"), "thumb_bend: real.noise = inf: "),
    "a count of 1e-9 N": (
        ("[0.1, 0.1,", "[1e-9, 0.1,"),
        "thumb: force_per_count = 1e-09: must be between 0.001 and 1 N",
    ),
    "a count of -0.1 N": (("[0.1, 0.1,", "[0.1, -0.1,"), "index: force_per_count = -0.1: "),
    "a count that is no number": (("[0.1, 0.1,", "[0.1, nan,"), "index: force_per_count = nan: "),
    "a count of 10 N": (("[0.1, 0.1,", "[10.0, 0.1,"), "thumb: force_per_count = 10: "),
    "an endless count": (("current_per_count = 0.001", "current_per_count = inf"), "current_per_count = inf: "),
    "a count of 50 mA": (
        ("current_per_count = 0.001", "current_per_count = 0.05"),
        "current_per_count = 0.05: .* 0.001",
    ),
    "no force for any torque": (
        ("force_per_torque = [12.0, 12.0,", "force_per_torque = [12.0, 0.5,"),
        "index: force_per_torque = 0.5: must be 0, or between 3.33 and 1000 N/Nm",
    ),
    "a force that is no number": (
        ("force_per_torque = [12.0, 12.0,", "force_per_torque = [nan, 12.0,"),
        "thumb: force_per_torque = nan: ",
    ),
    "an endless interval": (
        ("force_per_torque_high = [13.0, 13.0,", "force_per_torque_high = [13.0, inf,"),
        "index: its interval = inf: too large",
    ),
    "three forces per torque": (("force_per_torque = [12.0, 12.0,", "force_per_torque = ["), "must hold 5 number"),
    "no interval": (("force_per_torque_low", "force_per_torque_law"), "'force_per_torque_low' must hold 5 number"),
    "six counts": (("[0.1, 0.1,", "[0.1, 0.1, 0.1,"), "'force_per_count' must hold 5 number"),
    "a word for a number": ((PAIR, 'gain = ["a", "b"]'), "'gain' must hold 2 number"),
    "a number for a name": (('name = "thumb_bend"', "name = 7"), "'name' is missing or not a str"),
    "a number for a note": (('"pressed on Monday"', "7"), "'notes' holds what is not a str"),
    "a truth for a version": (("version = 1", "version = true"), "'version' is missing or not a int"),
    "a version of 4,000 digits": (("version = 1", f"version = {'9' * 4000}"), "is of version 9{20}, "),
    "a hand with a long name": (("xhand_right", "x" * 5000), "is of hand 'x+"),
}


@pytest.mark.parametrize("what", WRONG)
def test_what_no_hand_gives_is_named(hand, sound, tmp_path, what):
    (old, new), says = WRONG[what]
    assert old in sound
    assert re.search(says, refused(tmp_path / "c.toml", hand, sound.replace(old, new, 1)))


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        # Each line goes with the simulation's of its own direction, but not with the middle of both, which is used.
        (
            (
                ("gain = [0.04, 0.04]", "gain = [0.0001, 0.3]"),
                (PAIR, "gain = [0.0029, 0.0085]"),
                ("offset = [0.02, 0.02]", "offset = [31.0, 0.03]"),
            ),
            "thumb_bend: real.gain = 0.0029: .* need 0.0213 A",
        ),
        (
            (("gain = [0.04, 0.04]", "gain = [0.01, 0.19]"), ("offset = [0.02, 0.02]", "offset = [5.0, 0.02]")),
            "thumb_bend: real.offset = 5: without current .* 9.09",
        ),
    ],
)
def test_lines_are_checked_as_a_run_combines_them(hand, sound, tmp_path, changes, says):
    for old, new in changes:
        assert old in sound
        sound = sound.replace(old, new, 1)
    assert re.search(says, refused(tmp_path / "c.toml", hand, sound))


def test_a_file_from_before_has_no_force_per_torque(hand, sound, tmp_path):
    old = "\n".join(line for line in sound.splitlines() if not line.startswith("force_per_torque"))
    (tmp_path / "c.toml").write_text(old)
    assert load_calibration(tmp_path / "c.toml", hand).force_per_torque is None
    (tmp_path / "c.toml").write_text(sound)
    calibration = load_calibration(tmp_path / "c.toml", hand)
    np.testing.assert_array_equal(calibration.force_per_torque[:, 0], [12, 11, 13])
    wanted = [hand.force_per_torque[0], 12, 12, 12, 12]  # The thumb keeps its own.
    np.testing.assert_allclose(calibrated_hand(hand, calibration).force_per_torque, wanted)


def test_three_fingers_are_of_another_hand(hand, sound, tmp_path):
    text = sound.replace('"thumb", "index", "middle", "ring", "pinky"', '"thumb", "index", "middle"')
    text = text.replace("[0.1, 0.1, 0.1, 0.1, 0.1]", "[0.1, 0.1, 0.1]")
    text = re.sub(r"force_per_torque.*\n", "", text)
    assert "with 12 joints and 3 fingers, not of 'xhand_right'" in refused(tmp_path / "c.toml", hand, text)


@pytest.mark.parametrize("text", ["joint = 1", "joint = [1]", "joint = 'x'", "[joint]\na = 1"])
def test_joints_that_are_none(hand, sound, tmp_path, text):
    head = sound[: sound.index("[[joint]]")]
    line = refused(tmp_path / "c.toml", hand, f"{head}\n{text}\n[end]\ncomplete = true\n")
    assert "'joint'" in line


NUMBERS = st.one_of(st.floats(), st.floats(-3, 3), st.sampled_from([0.0, 1e-9, 1e9]))
VALUES = st.one_of(
    st.lists(NUMBERS, min_size=2, max_size=2).map(repr),
    NUMBERS.map(lambda number: repr([number] * 2)),
    NUMBERS.map(repr),
    st.lists(NUMBERS, min_size=5, max_size=5).map(repr),
    st.integers(-(10**30), 10**30).map(str),
    st.sampled_from(
        ["true", '"x"', "[]", "{}", "[[1], 2]", "1979-05-27", "-0.0", "1e-300", "1e300", "[nan, nan]", "'"]
    ),
)


@settings(max_examples=150)
@given(st.data())
def test_a_forged_file_is_refused_or_gives_torques_and_forces_of_a_hand(hand, sound, tmp_path_factory, data):
    lines = sound.splitlines()
    used = [i for i, line in enumerate(lines) if re.match(r"gain =|offset =|torque_scale|\w+_per_count", line)][:7]
    way = data.draw(st.sampled_from(["value", "value", "key", "drop", "double", "cut"]))
    at = data.draw(st.one_of(st.sampled_from(used), st.integers(0, len(lines) - 1)))
    value, where = data.draw(VALUES), data.draw(st.integers(0, len(lines[at])))
    name = lines[at].partition(" =")[0]
    forged = {
        "value": [f"{name} = {value}"],
        "key": [f"{value}{lines[at]}"],
        "drop": [],
        "double": [lines[at], lines[at]],
        "cut": [lines[at][:where]],
    }[way]
    path = tmp_path_factory.getbasetemp() / "forged.toml"
    path.write_text("\n".join([*lines[:at], *forged, *lines[at + 1 :]]))
    try:
        calibration = load_calibration(path, hand)
    except CalibrationError as error:
        line = str(error)
        assert line.startswith(f"{path}: ") and "\n" not in line and len(line) < len(str(path)) + 250
        return
    idle = np.asarray(normalised_torque(calibration, np.zeros(12, np.float32)))
    stalled = np.asarray(normalised_torque(calibration, np.full(12, 1.5, np.float32)))
    assert np.all(np.abs(idle) < 1.01) and np.all(np.abs(stalled) < 60)
    assert np.all(np.asarray(taxel_force(calibration, np.full((5, 1), 255.0, np.float32))) <= 255.0)
