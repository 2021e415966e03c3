"""A calibration file from anywhere: what no hand gives is refused in one line, in bounded time and memory."""

import dataclasses
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
    return Side(*lines, 0.01 * pair, pair, 50 * pair, *(np.ones(12) * v for v in (0.02, largest, 8.0)))


@pytest.fixture(scope="module")
def sound(hand):
    """Like the XHand's: 0.8 Nm/A at levers of 4 cm."""
    return Calibration(
        side(-0.05, 0.02, 0.5),
        side(0.04, 0.001, 0.3),
        np.asarray(hand.torque_limit, float),
        np.full(5, 0.1),
        hand=hand.name,
        joint_names=hand.joint_names,
        finger_names=hand.finger_names,
        notes=("pressed on Monday",),
        force_per_torque=np.array([[12.0] * 5, [11.0] * 5, [13.0] * 5]),
    )


def changed(calibration, name, value):
    """With other numbers, such as "real.gain", of the first joint or finger."""
    part, _, field = name.rpartition(".")
    owner = getattr(calibration, part) if part else calibration
    numbers = np.array(getattr(owner, field))
    numbers[(..., 0) if numbers.ndim else ()] = value
    owner = dataclasses.replace(owner, **{field: numbers})
    return dataclasses.replace(calibration, **{part: owner}) if part else owner


def refused(path, hand):
    """The one line that refuses a file."""
    with pytest.raises(CalibrationError) as caught:
        load_calibration(path, hand)
    line = str(caught.value)
    assert line.startswith(f"{path}: ") and "\n" not in line and len(line) < len(str(path)) + 250
    return line.removeprefix(f"{path}: ")


WRONG = [
    ({"real.gain": -1e-9}, "thumb_bend: current of the full torque by real.gain = 2.75e-08"),
    ({"real.gain": [-0.05, 0.05]}, "thumb_bend: real.gain unloading over loading = -1: must be between"),
    ({"real.gain": np.nan}, "thumb_bend: real.gain"),
    ({"sim.gain": 1.0}, "thumb_bend: magnitude of sim.gain = 1: must .* 0.3 Nm/N"),
    ({"real.offset": 5.0}, "thumb_bend: share of the full torque without current"),
    ({"torque_scale": 0.9}, "thumb_bend: torque_scale over the hand's limit = 0.8182"),
    ({"real.force_max": 1000.0}, "thumb_bend: real.force_max = 1000: .* 100 N"),
    ({"real.value_max": 100.0}, "thumb_bend: real.value_max = 100: .* 33 A"),
    ({"force_per_count": 1e-9}, "thumb: force_per_count = 1e-09: must be between 0.001 and 1 N"),
    ({"force_per_torque": 0.5}, "thumb: force_per_torque = 0.5: .* N/Nm"),
    # Each line goes with the simulation's of its own direction, but not with the middle of both, which is used.
    (
        {"sim.gain": [0.0001, 0.3], "real.gain": [0.0029, 0.0085], "real.offset": [31.0, 0.03]},
        "thumb_bend: current of the full torque by real.gain = 0.02126",
    ),
    (
        {"sim.gain": [0.01, 0.19], "real.offset": [5.0, 0.02]},
        "thumb_bend: share of the full torque without current by real.offset = 9.09",
    ),
]


@pytest.mark.parametrize(("changes", "says"), WRONG)
def test_numbers_that_no_hand_gives_are_refused(hand, sound, tmp_path, changes, says):
    for name, value in changes.items():
        sound = changed(sound, name, value)
    save_calibration(tmp_path / "c.toml", sound)
    assert re.search(says, refused(tmp_path / "c.toml", hand))


DAMAGED = [
    ("[-0.05,", f"[{10**400},", "damaged"),
    ("[-0.05,", '["a",', "damaged"),
    ("force_per_count = [", "force_per_count = [0.1, ", "'force_per_count' must hold 5 numbers"),
    ("friction = ", "fiction = ", "unknown entry 'fiction'"),
    ("version = 3", "version = 1", "expected version 3, got 1"),
    ('format = "dexsim calibration"', 'format = "other"', "not a calibration file"),
    ('"thumb_bend"', '"thumb_bent"', "calibrate this hand"),
    ("xhand_right", "x" * 5000, "is of hand 'x+"),
    ("[real]", "real = 1\n[other]", "damaged"),
]


@pytest.mark.parametrize(("old", "new", "says"), DAMAGED)
def test_a_damaged_file_is_refused(hand, sound, tmp_path, old, new, says):
    path = tmp_path / "c.toml"
    save_calibration(path, sound)
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new, 1))
    assert re.search(says, refused(path, hand))


def test_force_per_torque_reaches_the_hand(hand, sound, tmp_path):
    save_calibration(tmp_path / "c.toml", sound)
    calibration = load_calibration(tmp_path / "c.toml", hand)
    np.testing.assert_array_equal(calibration.force_per_torque[:, 0], [12, 11, 13])
    expected = [hand.force_per_torque[0], 12, 12, 12, 12]  # The thumb keeps its own.
    np.testing.assert_allclose(calibrated_hand(hand, calibration).force_per_torque, expected)
    # Presses from Python have none.
    save_calibration(tmp_path / "c.toml", dataclasses.replace(sound, force_per_torque=None))
    assert load_calibration(tmp_path / "c.toml", hand).force_per_torque is None


NUMBERS = st.one_of(st.floats(), st.floats(-3, 3), st.sampled_from([0.0, 1e-9, 1e9]))
PAIRS = st.one_of(NUMBERS, st.lists(NUMBERS, min_size=2, max_size=2))
LINES = st.sampled_from(["real.gain", "real.offset", "sim.gain", "sim.offset"])
SINGLES = st.sampled_from(["torque_scale", "force_per_count"])


@settings(max_examples=150)
@given(st.lists(st.one_of(st.tuples(LINES, PAIRS), st.tuples(SINGLES, NUMBERS)), min_size=1, max_size=3))
def test_a_forged_file_is_refused_or_gives_torques_and_forces_of_a_hand(hand, sound, tmp_path_factory, changes):
    for name, value in changes:
        sound = changed(sound, name, value)
    path = tmp_path_factory.getbasetemp() / "forged.toml"
    save_calibration(path, sound)
    try:
        calibration = load_calibration(path, hand)
    except CalibrationError as error:
        assert str(error).startswith(f"{path}: ") and "\n" not in str(error)
        return
    idle = np.asarray(normalised_torque(calibration, np.zeros(12, np.float32)))
    stalled = np.asarray(normalised_torque(calibration, np.full(12, 1.5, np.float32)))
    assert np.all(np.abs(idle) < 1.01) and np.all(np.abs(stalled) < 60)
    assert np.all(np.asarray(taxel_force(calibration, np.full((5, 1), 255.0, np.float32))) <= 255.0)
