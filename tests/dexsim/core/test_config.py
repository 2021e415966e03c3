"""Configuration: every refusal names the field, the value, its unit and its range; the round trip keeps all."""

import dataclasses
import importlib
import json
import math
import typing

import pytest
from paths import ROOT

from dexsim.core.config import Config, Range, from_dict, override, setting, to_dict
from dexsim.errors import ConfigError
from dexsim.objects.config import ObjectConfig
from dexsim.randomization import Randomization
from dexsim.tasks.grasp.config import GraspConfig


@dataclasses.dataclass(frozen=True, kw_only=True)
class Spring(Config):
    """A spring."""

    stiffness: float = setting(2.0, unit="N/m", low=0.5, high=8.0)
    """Force over
    length."""
    turns: int = setting(3, low=1)
    """Number of turns."""
    rest: float = setting(0.0, unit="m", high=0.1)
    span: Range = setting((0.0, 1.0), unit="m", low=-1.0, high=2.0)
    wire: str = setting("steel", choices=("steel", "brass"))
    marks: tuple[str, ...] = setting((), choices=("red", "blue"))
    name: str | None = setting(None)
    wound: bool = setting(True)
    side: typing.Literal["left", "right"] | None = None


@dataclasses.dataclass(frozen=True, kw_only=True)
class Chair(Config):
    legs: int = setting()
    seat: Spring = setting(Spring())


def test_docstrings_list_fields_with_texts_units_and_ranges():
    listed = ["  stiffness: Force over length. [N/m, 0.5 to 8]", "  turns: Number of turns. [1 or more]"]
    assert Spring.__doc__.splitlines() == ["A spring.", "", "Attributes:", *listed]
    assert "  pool_size: Start states generated once" in GraspConfig.__doc__, "a field of its base"
    assert "  mass: Mass of the object. [kg, 0.001 to 5]" in ObjectConfig.__doc__


def message(build, *arguments, **keywords):
    with pytest.raises(ConfigError) as caught:
        build(*arguments, **keywords)
    text = str(caught.value)
    assert "\n" not in text
    return text


REFUSED = [
    (dict(stiffness=9.0), "Spring.stiffness = 9 N/m: must be between 0.5 and 8 N/m"),
    (dict(turns=0), "Spring.turns = 0: must be between 1 and inf"),
    (dict(rest=0.2), "Spring.rest = 0.2 m: must be between -inf and 0.1 m"),
    (dict(stiffness="2"), "Spring.stiffness = '2': expected float"),
    (dict(turns=3.0), "Spring.turns = 3.0: expected int"),
    (dict(turns=True), "Spring.turns = True: expected int"),
    (dict(span=1.0), "Spring.span = 1.0: expected a list"),
    (dict(span=(1.0,)), "Spring.span: expected 2 values, got 1"),
    (dict(span=(0.0, 3.0)), "Spring.span = 3 m: must be between -1 and 2 m"),
    (dict(span=(1.0, 0.5)), "Spring.span = (1, 0.5): the first must not exceed the second"),
    (dict(wire="tin"), "Spring.wire = 'tin': choose from steel, brass"),
    (dict(marks=("red", "green")), "Spring.marks = 'green': choose from red, blue"),
    (dict(name=4), "Spring.name = 4: expected str"),
    (dict(wound="no"), "Spring.wound = 'no': expected bool"),
    (dict(side="top"), "Spring.side = 'top': choose from left, right"),
    (dict(stiffness=math.nan), "Spring.stiffness = nan: must be a finite number"),
]


@pytest.mark.parametrize(("fields", "expected"), REFUSED)
def test_a_wrong_value_is_named_with_its_range_in_code_and_in_a_file(fields, expected):
    assert message(Spring, **fields) == expected
    assert message(from_dict, Chair, {"legs": 4, "seat": fields}) == expected


@pytest.mark.parametrize(
    "fields",
    [
        dict(
            stiffness=0.5, turns=99, span=(-1.0, 0.1), wire="brass", marks=("red", "blue"), name='ä \\ "\n', wound=False
        ),
        dict(stiffness=2 / 3, name="", side="left"),
    ],
)
def test_a_config_survives_the_round_trip(fields):
    chair = Chair(seat=Spring(**fields), legs=3)
    again = from_dict(Chair, json.loads(json.dumps(to_dict(chair))))
    assert again == chair and hash(again) == hash(chair)  # usable as a static argument


def test_no_configuration_takes_settings_by_position_or_changes():
    """By position a number would become another setting with the next field; static arguments must not change."""
    folders = "dexsim/env dexsim/tasks dexsim/touch dexsim_ppo/learner dexsim_real/control dexsim_real/sensors".split()
    paths = [path for folder in folders for path in (ROOT / folder).rglob("*.py")] + [ROOT / "dexsim/observation.py"]
    for path in paths:
        importlib.import_module(".".join(path.relative_to(ROOT).with_suffix("").parts))
    for kind in [kind for kind in Config.__subclasses__() if kind.__module__.startswith("dexsim")]:
        assert kind.__dataclass_params__.frozen and all(field.kw_only for field in dataclasses.fields(kind)), kind


@pytest.mark.parametrize(
    ("data", "expected"),
    [
        ({"backs": 1}, "Chair has no field 'backs'"),
        ({"seat": {}}, "Chair.legs is missing"),
        ({"legs": 4, "seat": {"colour": "red"}}, "Spring has no field 'colour'"),
        ({"legs": 4, "seat": 3}, "Spring: expected a table of fields, got int"),
    ],
)
def test_a_dictionary_of_other_fields_is_an_error(data, expected):
    assert message(from_dict, Chair, data) == expected


def test_override_replaces_fields_by_their_path():
    plain = to_dict(GraspConfig())
    changed = override(plain, ["objects.extremes=0.5", 'objects.shapes=["box"]', "randomization.latency=[0, 0.01]"])
    assert from_dict(GraspConfig, changed) == GraspConfig(
        objects=ObjectConfig(extremes=0.5, shapes=("box",)), randomization=Randomization(latency=(0.0, 0.01))
    )
    # Numbers as Python has them, in lists too.
    for text, number in ((".006", 0.006), ("6e-3", 0.006), ("5.", 5.0), ("-.5", -0.5)):
        assert override({}, [f"physics.timestep={text}"]) == {"physics": {"timestep": number}}
    assert override({}, ["edge=[.05, 1.]"]) == {"edge": [0.05, 1.0]}
    for entry, said in (
        ("objects.extreme=1", "ObjectConfig has no field 'extreme'"),
        ("objects.extremes=much", "expected float"),
        ("extremes=", "expected NAME=VALUE"),
    ):
        with pytest.raises(ConfigError, match=said):
            from_dict(GraspConfig, override(plain, [entry]))
