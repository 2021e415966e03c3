"""A user's plant that misbehaves: what it raises or returns wrongly is one line with the option and the member."""

import dataclasses

import numpy as np
import pytest
from twin_plant import ScriptedPlant

from dexsim_real.core.errors import HandError
from dexsim_real.twin.checked import CheckedPlant
from dexsim_real.twin.wire.firmware import idle_motors


def checked(**changes):
    plant = ScriptedPlant()
    for name, value in changes.items():
        setattr(plant, name, value)
    return CheckedPlant(plant, "--plant mine")


def measured(**fields):
    plant = ScriptedPlant()
    return checked(measure=lambda: dataclasses.replace(plant.measure(), **fields)).measure


def test_a_sound_plant_is_passed_on():
    plant, ours = ScriptedPlant(), CheckedPlant(ScriptedPlant(), "--plant mine")
    for one in (plant, ours):
        one.drive(idle_motors())
        one.advance(0.01)
        one.warm(3, 20.0)
    for name, value in dataclasses.asdict(plant.measure()).items():
        np.testing.assert_array_equal(getattr(ours.measure(), name), value)
    for found, wanted in zip(ours.measure_object(), plant.measure_object(), strict=True):
        np.testing.assert_array_equal(found, wanted)
    assert ours.results() == plant.results() and ours.shape == plant.shape and ours.trial == plant.trial
    np.testing.assert_array_equal(ours.up, plant.up)
    assert measured(current=[1.0] * 12)().current.shape == (12,)  # Lists are arrays, too.


def fail(*_):
    raise ValueError("my physics\nblew up")


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (lambda: checked(advance=fail).advance(0.01), "advance fails: ValueError: my physics blew up"),
        (lambda: checked(drive=lambda: None).drive(idle_motors()), "drive fails: TypeError: .* takes 0 positional"),
        (lambda: checked(measure=lambda: None).measure(), r"time has numbers that are not finite"),
        (measured(current=np.zeros(10)), r"current has the shape \(10,\); expected \(12,\)"),
        (measured(joint_position=np.full(12, np.nan)), "joint_position has numbers that are not finite"),
        (measured(temperature="warm"), "temperature is 'warm'; expected numbers"),
        (measured(object_quat=np.zeros(4)), "object_quat has no length"),
        (lambda: checked(measure_object=lambda: None).measure_object(), "returned None; expected three arrays"),
        (lambda: checked(up=np.zeros(3)).up, "up has no length"),
        (lambda: checked(shape="box").shape, "its shape is 'box'; expected an `ObjectShape`"),
        (lambda: checked(results=lambda: [{"hand": object()}]).results(), "expected a list of dicts as JSON has them"),
        (lambda: checked(results=lambda: None).results(), "returned None; expected a list of dicts"),
    ],
)
def test_what_is_wrong_is_one_line(call, says):
    with pytest.raises(HandError, match=says) as error:
        call()
    assert str(error.value).startswith("--plant mine: ") and "\n" not in str(error.value)
