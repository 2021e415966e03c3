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
    path.write_text(text)
    with pytest.raises(CalibrationError) as caught:
        load_calibration(path, hand)
    line = str(caught.value)
    assert line.startswith(f"{path}: ") and "\n" not in line and len(line) < len(str(path)) + 250
    return line.removeprefix(f"{path}: ")


PAIR, OFFSET = "gain = [-0.05, -0.05]", "offset = [0.02, 0.02]"
WRONG = [
    (PAIR, "gain = [-1e-9, -1e-9]", "thumb_bend: current of the full torque by real.gain = 2.75e-08"),
    (PAIR, "gain = [-1e9, -1e9]", "thumb_bend: current of the full torque by real.gain = 2.75e.10"),
    (PAIR, "gain = [-0.05, 0.05]", "thumb_bend: real.gain unloading over loading = -1: must be between"),
    (PAIR, "gain = [0.0, 0.0]", "thumb_bend: real.gain unloading over loading = nan"),
    (PAIR, "gain = [nan, nan]", "thumb_bend: real.gain"),
    (PAIR, f"gain = [{10**400}, 1]", "damaged"),
    (PAIR, 'gain = ["a", "b"]', "damaged"),
    ("gain = [0.04, 0.04]", "gain = [1.0, 1.0]", "thumb_bend: magnitude of sim.gain = 1: must .* 0.3 Nm/N"),
    (OFFSET, "offset = [5.0, 5.0]", "thumb_bend: share of the full torque without current"),
    (OFFSET, "offset = [-5.0, -5.0]", "thumb_bend: share of the full torque without current"),
    (OFFSET, "offset = [inf, inf]", "thumb_bend: share of the full torque without current"),
    ("torque_scale = 1.1", "torque_scale = 0.9", "thumb_bend: torque_scale over the hand's limit = 0.8182"),
    ("torque_scale = 1.1", "torque_scale = -1.1", "thumb_bend: torque_scale = -1.1: must be between 0.01 and 20 Nm"),
    ("force_max = 8.0", "force_max = 1000.0", "thumb_bend: real.force_max = 1000: .* 100 N"),
    ("value_max = 0.5", "value_max = 100.0", "thumb_bend: real.value_max = 100: .* 33 A"),
    ("[0.1, 0.1,", "[1e-9, 0.1,", "thumb: force_per_count = 1e-09: must be between 0.001 and 1 N"),
    ("[0.1, 0.1,", "[0.1, -0.1,", "index: force_per_count = -0.1: "),
    ("[0.1, 0.1,", "[10.0, 0.1,", "thumb: force_per_count = 10: "),
    ("[0.1, 0.1,", "[0.1, 0.1, 0.1,", "'force_per_count' must hold 5 number"),
    ("current_per_count = 0.001", "current_per_count = inf", "current_per_count = inf: "),
    ("current_per_count = 0.001", "current_per_count = 0.05", "current_per_count = 0.05: .* 0.001"),
    ("force_per_torque = [12.0, 12.0,", "force_per_torque = [12.0, 0.5,", "index: force_per_torque = 0.5: .* N/Nm"),
    ("force_per_torque = [12.0, 12.0,", "force_per_torque = [nan, 12.0,", "thumb: force_per_torque = nan: "),
    ("force_per_torque_low", "force_per_torque_law", "KeyError: 'force_per_torque_low'"),
    ("friction = ", "fiction = ", "KeyError: 'friction'"),
    ("version = 1", "version = 2", "it has version 2, this library reads 1"),
    ("version = 1", f"version = {'9' * 4000}", "damaged"),
    ('format = "dexsim calibration"', 'format = "other"', "not a calibration file"),
    ("complete = true", "complete = false", "its end is missing"),
    ('name = "thumb_bend"', 'name = "thumb_bent"', "calibrate this hand"),
    ("xhand_right", "x" * 5000, "is of hand 'x+"),
    ("[[joint]]", "joint = 1\n[[other]]", "damaged"),
]


@pytest.mark.parametrize(("old", "new", "says"), WRONG)
def test_a_file_that_no_hand_gives_is_refused(hand, sound, tmp_path, old, new, says):
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
                (OFFSET, "offset = [31.0, 0.03]"),
            ),
            "thumb_bend: current of the full torque by real.gain = 0.02126",
        ),
        (
            (("gain = [0.04, 0.04]", "gain = [0.01, 0.19]"), (OFFSET, "offset = [5.0, 0.02]")),
            "thumb_bend: share of the full torque without current by real.offset = 9.09",
        ),
    ],
)
def test_lines_are_checked_as_a_run_combines_them(hand, sound, tmp_path, changes, says):
    for old, new in changes:
        assert old in sound
        sound = sound.replace(old, new, 1)
    assert re.search(says, refused(tmp_path / "c.toml", hand, sound))


def test_force_per_torque_reaches_the_hand(hand, sound, tmp_path):
    (tmp_path / "c.toml").write_text(sound)
    calibration = load_calibration(tmp_path / "c.toml", hand)
    np.testing.assert_array_equal(calibration.force_per_torque[:, 0], [12, 11, 13])
    expected = [hand.force_per_torque[0], 12, 12, 12, 12]  # The thumb keeps its own.
    np.testing.assert_allclose(calibrated_hand(hand, calibration).force_per_torque, expected)
    # Presses from Python have none.
    (tmp_path / "c.toml").write_text(re.sub(r"force_per_torque.*\n", "", sound))
    assert load_calibration(tmp_path / "c.toml", hand).force_per_torque is None


def test_an_endless_file_ends(hand):
    with pytest.raises(CalibrationError, match="/dev/zero: damaged.*larger than 1 MiB"):
        load_calibration("/dev/zero", hand)


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
