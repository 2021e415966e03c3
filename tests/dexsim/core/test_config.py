"""Configuration: every refusal names the field, the value, its unit and its range; the round trip keeps all."""

import dataclasses
import json
import math
import typing

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dexsim.core.config import check_ranges, from_dict, naming_file, override, setting, to_dict, validate
from dexsim.core.errors import ConfigError, DexsimError
from dexsim.objects.config import ObjectConfig
from dexsim.physics.config import PhysicsConfig
from dexsim.randomization import Randomization
from dexsim.sensing.taxels import TaxelSensor
from dexsim.tasks.grasp.config import GraspConfig, GraspReward
from dexsim.touch.skin import Skin


@dataclasses.dataclass(frozen=True, kw_only=True)
class Spring:
    stiffness: float = setting(2.0, unit="N/m", low=0.5, high=8.0)
    turns: int = setting(3, low=1)
    rest: float = setting(0.0, unit="m", high=0.1)
    span: tuple[float, float] = setting((0.0, 1.0), unit="m", low=-1.0, high=2.0)
    wire: str = setting("steel", choices=("steel", "brass"))
    marks: tuple[str, ...] = setting((), choices=("red", "blue"))
    name: str | None = setting(None)
    wound: bool = setting(True)

    def __post_init__(self):
        validate(self)
        check_ranges(self, "span")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Chair:
    seat: Spring = setting(Spring())
    legs: int = setting(4)

    def __post_init__(self):
        validate(self)


def message(build, *arguments, **keywords):
    with pytest.raises(ConfigError) as caught:
        build(*arguments, **keywords)
    text = str(caught.value)
    assert "\n" not in text
    return text


@pytest.mark.parametrize(
    ("fields", "wanted"),
    [
        (dict(stiffness=9.0), "Spring.stiffness = 9 N/m: must be between 0.5 and 8 N/m"),
        (dict(stiffness=0.25), "Spring.stiffness = 0.25 N/m: must be between 0.5 and 8 N/m"),
        (dict(turns=0), "Spring.turns = 0: must be at least 1"),
        (dict(rest=0.2), "Spring.rest = 0.2 m: must be at most 0.1 m"),
        (dict(stiffness="2"), "Spring.stiffness = '2': expected float"),
        (dict(stiffness=None), "Spring.stiffness = None: expected float"),
        (dict(turns=3.0), "Spring.turns = 3.0: expected int"),
        (dict(turns=True), "Spring.turns = True: expected int"),
        (dict(span=1.0), "Spring.span = 1.0: expected a list"),
        (dict(span=(1.0,)), "Spring.span: expected 2 values, got 1"),
        (dict(wound="no"), "Spring.wound = 'no': expected bool"),
        (dict(span=(0.0, 3.0)), "Spring.span = 3 m: must be between -1 and 2 m"),
        (dict(span=(1.0, 0.5)), "Spring.span = (1, 0.5): the first must not exceed the second"),
        (dict(wire="tin"), "Spring.wire = 'tin': choose from steel, brass"),
        (dict(marks=("red", "green")), "Spring.marks = 'green': choose from red, blue"),
        (dict(stiffness=math.nan), "Spring.stiffness = nan: must be a finite number"),
        (dict(rest=-math.inf), "Spring.rest = -inf: must be a finite number"),
        (dict(span=(0.0, math.nan)), "Spring.span = nan: must be a finite number"),
    ],
)
def test_a_refusal_says_what_where_and_which_range(fields, wanted):
    assert message(Spring, **fields) == wanted


def test_the_ends_of_a_range_belong_to_it():
    for stiffness in (0.5, 8.0):
        assert Spring(stiffness=stiffness).stiffness == stiffness
    assert Spring(span=(1.0, 1.0), marks=("red", "blue", "red")).span == (1.0, 1.0)


def test_config_errors_are_the_librarys():
    assert issubclass(ConfigError, DexsimError)


@pytest.mark.parametrize(
    ("build", "fields", "words"),
    [
        (Skin, dict(thickness=0.0), ("Skin.thickness", "0 m", "0.0001 and 0.02 m")),
        (TaxelSensor, dict(saturation=0.0), ("TaxelSensor.saturation", "0 N", "0.1 and 1000 N")),
        (PhysicsConfig, dict(timestep=0.5), ("PhysicsConfig.timestep", "0.5 s", "0.0001 and 0.02 s")),
        (PhysicsConfig, dict(contacts="fist"), ("PhysicsConfig.contacts", "'fist'", "closed, mjx")),
        (ObjectConfig, dict(mass=(0.3, 0.1)), ("ObjectConfig.mass", "0.3, 0.1")),
        (Randomization, dict(latency=(0.0, 1.0)), ("Randomization.latency", "1 s", "0 and 0.2 s")),
        (GraspReward, dict(drop=3.0), ("GraspReward.drop", "3", "-10000 and 0")),
        (GraspConfig, dict(finger_force=(5.0, 2.0)), ("GraspConfig.finger_force", "5, 2")),
        (GraspConfig, dict(pool_size=0), ("GraspConfig.pool_size", "0", "1 and 1000000")),
    ],
)
def test_the_librarys_own_configs_refuse_alike(build, fields, words):
    text = message(build, **fields)
    assert all(word in text for word in words), text


def nested_configs(cls):
    yield cls
    for field in dataclasses.fields(cls):
        hint = typing.get_type_hints(cls)[field.name]
        if dataclasses.is_dataclass(hint):
            yield from nested_configs(hint)


def test_every_number_of_the_grasp_config_has_a_range_that_is_enforced():
    """Whatever the field, a value far below and far above is refused, by name."""
    checked = 0
    for cls in set(nested_configs(GraspConfig)):
        for field in dataclasses.fields(cls):
            value = getattr(cls(), field.name)
            first = value[0] if isinstance(value, tuple) and value else value
            if isinstance(first, (bool, str)) or not isinstance(first, (int, float)):
                continue
            for bad in (-1e9, 1e9):
                bad = type(first)(bad)
                text = message(cls, **{field.name: (bad,) * len(value) if isinstance(value, tuple) else bad})
                assert f"{cls.__name__}.{field.name} = {bad:.0f}" in text
                unit = field.metadata["unit"]
                assert unit in ("", "1") or unit in text
            checked += 1
    assert checked > 60


# --- dictionaries ------------------------------------------------------------------------------------


def test_the_round_trip_of_the_grasp_config():
    for config in (
        GraspConfig(),
        GraspConfig(
            finger_force=(0.5, 9.0),
            pool_size=17,
            reward=GraspReward(sigma=0.2, thumb="binary"),
            objects=ObjectConfig(shapes=("box",), mass=(0.1, 0.1)),
            physics=PhysicsConfig(timestep=0.004),
            randomization=Randomization(scale=0.5),
        ),
    ):
        plain = to_dict(config)
        again = from_dict(GraspConfig, json.loads(json.dumps(plain)))
        assert again == config and type(again.reward) is GraspReward
        assert again.objects.shapes == config.objects.shapes and isinstance(again.objects.shapes, tuple)
        assert hash(again) == hash(config)  # usable as a static argument


def test_fields_left_out_keep_their_default():
    config = from_dict(GraspConfig, {"reward": {"sigma": 0.3}})
    assert config == dataclasses.replace(GraspConfig(), reward=GraspReward(sigma=0.3))


@given(
    st.floats(0.5, 8.0),
    st.integers(1, 99),
    st.floats(-1, 0),
    st.floats(0, 2),
    st.sampled_from(["steel", "brass"]),
    st.lists(st.sampled_from(["red", "blue"]), max_size=3),
    st.none() | st.text(max_size=5),
    st.booleans(),
)
def test_any_config_survives_the_round_trip(stiffness, turns, low, high, wire, marks, name, wound):
    spring = Spring(
        stiffness=stiffness, turns=turns, span=(low, high), wire=wire, marks=tuple(marks), name=name, wound=wound
    )
    chair = Chair(seat=spring, legs=3)
    assert from_dict(Chair, to_dict(chair)) == chair
    assert from_dict(Chair, json.loads(json.dumps(to_dict(chair)))) == chair


@pytest.mark.parametrize(
    ("data", "wanted"),
    [
        ({"backs": 1}, "Chair has no field 'backs'"),
        ({"seat": {"colour": "red"}}, "Spring has no field 'colour'"),
        ({"legs": "four"}, "Chair.legs = 'four': expected int"),
        ({"legs": 4.5}, "Chair.legs = 4.5: expected int"),
        ({"legs": True}, "Chair.legs = True: expected int"),
        ({"legs": None}, "Chair.legs = None: expected int"),
        ({"seat": 3}, "Spring: expected a table of fields, got int"),
        ({"seat": {"stiffness": "hard"}}, "Spring.stiffness = 'hard': expected float"),
        ({"seat": {"stiffness": False}}, "Spring.stiffness = False: expected float"),
        ({"seat": {"stiffness": 99.0}}, "Spring.stiffness = 99 N/m: must be between 0.5 and 8 N/m"),
        ({"seat": {"wire": 3}}, "Spring.wire = 3: expected str"),
        ({"seat": {"wound": 1}}, "Spring.wound = 1: expected bool"),
        ({"seat": {"span": [1.0]}}, "Spring.span: expected 2 values, got 1"),
        ({"seat": {"span": 1.0}}, "Spring.span = 1.0: expected a list"),
        ({"seat": {"span": [0.0, "far"]}}, "Spring.span = 'far': expected float"),
        ({"seat": {"marks": "red"}}, "Spring.marks = 'red': expected a list"),
        ({"seat": {"marks": [1]}}, "Spring.marks = 1: expected str"),
        ({"seat": {"name": 4}}, "Spring.name = 4: expected str"),
        ([], "Chair: expected a table of fields, got list"),
    ],
)
def test_a_bad_dictionary_is_refused_by_name(data, wanted):
    assert message(from_dict, Chair, data) == wanted


def test_errors_of_a_file_begin_with_its_name():
    with pytest.raises(ConfigError, match=r"^hand\.toml: Spring\.stiffness = 9 N/m: must be between 0\.5 and 8 N/m$"):
        with naming_file("hand.toml"):
            from_dict(Spring, {"stiffness": 9.0})


def test_literal_types_are_choices():
    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Door:
        side: typing.Literal["left", "right"] | None = None
        marks: tuple[typing.Literal[1, 2], ...] = ()

        def __post_init__(self):
            validate(self)

    assert Door(side="left", marks=(1, 2)) and Door(side=None)
    assert message(Door, side="top") == "Door.side = 'top': choose from left, right"
    assert message(Door, marks=(3,)) == "Door.marks = 3: choose from 1, 2"


def test_a_whole_number_serves_as_a_real_one():
    spring = from_dict(Spring, {"stiffness": 4, "span": [0, 1]})
    assert spring == Spring(stiffness=4.0) and type(spring.stiffness) is float


def test_units_and_ranges_are_there_for_the_command_line_and_the_documents():
    field = next(f for f in dataclasses.fields(Spring) if f.name == "stiffness")
    assert dict(field.metadata) == {"unit": "N/m", "low": 0.5, "high": 8.0, "choices": None}


def test_override_replaces_fields_by_their_path():
    plain = to_dict(GraspConfig())
    before = json.dumps(plain)
    changed = override(
        plain,
        [
            "objects.extremes=0.5",
            'objects.shapes=["box"]',
            "randomization.latency=[0, 0.01]",
            "episode_seconds=3",
        ],
    )
    config = from_dict(GraspConfig, changed)
    assert json.dumps(plain) == before
    wanted = dataclasses.replace(
        GraspConfig(),
        episode_seconds=3.0,
        objects=dataclasses.replace(ObjectConfig(), extremes=0.5, shapes=("box",)),
        randomization=dataclasses.replace(Randomization(), latency=(0.0, 0.01)),
    )
    assert config == wanted
    # Numbers as Python has them, in lists too.
    for text, number in ((".006", 0.006), ("6e-3", 0.006), ("5.", 5.0), ("-.5", -0.5)):
        assert override({}, [f"physics.timestep={text}"]) == {"physics": {"timestep": number}}
    assert override({}, ["edge=[.05, 1.]"]) == {"edge": [0.05, 1.0]}
    # A field that the file does not have yet.
    assert from_dict(GraspConfig, override({}, ["objects.extremes=1"])).objects.extremes == 1.0
    for entry, said in (
        ("objects.extreme=1", "ObjectConfig has no field 'extreme'"),
        ("objects.extremes=7", "between 0 and 1"),
        ("objects.extremes=much", "expected float"),
        ("objects=1", "expected a table"),
        ("episode_seconds.x=1", "expected float"),
        ("extremes", "expected NAME=VALUE"),
        ("=1", "expected NAME=VALUE"),
        ("extremes=", "expected NAME=VALUE"),
    ):
        with pytest.raises(ConfigError, match=said):
            from_dict(GraspConfig, override(plain, [entry]))


def test_a_type_that_only_a_type_checker_knows_does_not_hinder_the_check():
    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Lamp:
        colour: str = setting("red", choices=("red", "blue"))
        bulb: "Nowhere" = None  # noqa: F821

        def __post_init__(self):
            validate(self)

    assert message(Lamp, colour="green") == "Lamp.colour = 'green': choose from red, blue"


def test_a_configuration_is_no_table_and_numbers_of_numpy_become_pythons():
    """As a file gives them back, so that they are saved, hashed and compared like those that were read."""
    assert message(Chair, seat={"turns": 3}) == "Chair.seat = {'turns': 3}: expected a Spring"
    spring = Spring(turns=np.int64(4), stiffness=np.float32(2.5), span=[np.float32(0.5), 1], wound=np.bool_(False))
    assert spring == from_dict(Spring, json.loads(json.dumps(to_dict(spring))))
    assert type(spring.turns) is int and type(spring.stiffness) is float and spring.span == (0.5, 1)
    assert Spring(span=np.array([0.25, 0.5])).span == (0.25, 0.5) and hash(spring)
