"""Options of a command: their names, their help, and what is said of a command line that is refused."""

import dataclasses
import math
import subprocess
import sys
from pathlib import Path
from typing import Annotated, Literal

import pytest
import tyro
from hypothesis import given
from hypothesis import strategies as st

from dexsim.core import cli
from dexsim.core.config import check_ranges, setting, validate
from dexsim.core.options import options_of


@dataclasses.dataclass(frozen=True, kw_only=True)
class Spring:
    """A nested group."""

    rest_length: float = setting(0.1, unit="m", low=0.0, high=2.0)
    """Length without a load."""
    span: tuple[float, float] = setting((0.0, 1.0), unit="m", low=-1.0, high=3.0)
    """Shortest and longest
    length."""
    wire: str = setting("steel", choices=("steel", "brass"))
    """Material."""
    wound: bool = True
    """Wound or straight."""

    def __post_init__(self):
        validate(self)
        check_ranges(self, "span")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Chair:
    """Options of a command."""

    name: Annotated[str, tyro.conf.Positional]
    """Whose chair."""
    owner: str
    """Who made it."""
    legs: int = setting(4, unit="1", low=1, high=100_000)
    """Number of legs."""
    colour: Literal["red", "blue"] = "red"
    """Colour of the seat."""
    weights: tuple[float, ...] = setting((1.5, 2.0), unit="kg", low=0.0)
    """Weight of each leg."""
    sides: tuple[bool, bool] = (True, False)
    """Armrests."""
    output: Path | None = None
    """File for a drawing; None draws nothing."""
    seat: Spring = setting(Spring(rest_length=0.5))
    """The seat's springs."""

    def __post_init__(self):
        validate(self)


GIVEN = ["anna", "--owner", "me"]


def parse(*argv, default=None):
    return cli.parse(Chair, [*argv], prog="chair", description="Builds a chair.", default=default)


def refused(*argv):
    with pytest.raises(cli.UsageError) as caught:
        parse(*argv)
    text = str(caught.value)
    assert "\n" not in text and "Chair" not in text and "Spring" not in text
    return text.removesuffix("; see --help")


def page(capsys, *argv):
    with pytest.raises(SystemExit) as stop:
        parse(*argv)
    assert stop.value.code == 0
    return capsys.readouterr().out


def test_values_are_parsed():
    chair = parse(*GIVEN, "--seat.span", "-0.5", "2", "--seat.no-wound", "--legs=3", "--colour", "blue")
    assert chair == Chair(
        name="anna", owner="me", legs=3, colour="blue", seat=Spring(span=(-0.5, 2.0), wound=False, rest_length=0.5)
    )


def test_names_are_those_that_the_parser_takes():
    """Independent of our naming: each option's name, with its default as the value, parses to that default."""
    default = parse(*GIVEN)
    for option in options_of(Chair, default):
        if option.positional or option.default is None:
            continue
        values = option.default if isinstance(option.default, tuple) else (option.default,)
        argv = [option.name] if option.hint is bool else [option.name, *map(str, values)]
        assert parse(*GIVEN, *argv) == default
        if option.hint is bool:
            assert parse(*GIVEN, option.negation) != default


@pytest.mark.parametrize(
    ("argv", "wanted"),
    [
        (["--legs", "0"], "--legs 0: must be between 1 and 100000"),
        (["--legs", "1.5"], "--legs 1.5: expected a whole number"),
        (["--legs", "1", "2"], "--legs 1 2: expected a whole number"),
        (["--legs"], "--legs: expected a whole number"),
        (["--legs=many"], "--legs many: expected a whole number"),
        (["--colour", "green"], "--colour green: choose from red, blue"),
        (["--weights", "1", "-2"], "--weights -2 kg: must be at least 0 kg"),
        (["--weights", "nan"], "--weights nan: must be a finite number"),
        (["--weights", "heavy"], "--weights heavy: expected numbers"),
        (["--sides", "True"], "--sides True: expected 2 values, each True or False"),
        (["--seat.rest-length", "9"], "--seat.rest-length 9 m: must be between 0 and 2 m"),
        (["--seat.rest_length", "9"], "--seat.rest-length 9 m: must be between 0 and 2 m"),
        (["--seat.span", "1"], "--seat.span 1: expected 2 numbers"),
        (["--seat.span", "1", "x"], "--seat.span 1 x: expected 2 numbers"),
        (["--seat.span", "2", "1"], "--seat.span 2 1: the first must not exceed the second"),
        (["--seat.wire", "tin"], "--seat.wire tin: choose from steel, brass"),
        (["--seat.wound", "no"], "--seat.wound no: takes no value; --seat.no-wound switches it off"),
        (["--seat.rest-lenght", "1"], "--seat.rest-lenght: no such option (perhaps --seat.rest-length)"),
        (["--rest-length", "1"], "--rest-length: no such option (perhaps --seat.rest-length)"),
        (["--zzz"], "--zzz: no such option"),
        (["--help-all", "sofa"], "--help-all sofa: choose from seat"),
    ],
)  # fmt: skip
def test_a_refusal_names_the_option_as_it_is_typed(argv, wanted):
    assert refused(*GIVEN, *argv) == wanted


def test_what_is_missing_and_what_is_too_much():
    assert refused() == "NAME and --owner must be given"
    assert refused("anna") == "--owner must be given"
    assert refused("--owner", "me") == "NAME must be given"
    assert refused("anna", "berta", "--owner", "me") == "berta: not an option"


@given(st.floats() | st.integers(-(10**6), 10**6))
def test_whatever_the_number_it_is_taken_or_refused_by_name(number):
    for name, low, high, whole in (("--seat.rest-length", 0, 2, False), ("--legs", 1, 100_000, True)):
        fits = math.isfinite(number) and low <= number <= high and (isinstance(number, int) or not whole)
        if fits:
            parse(*GIVEN, f"{name}={number}")
        else:
            assert refused(*GIVEN, f"{name}={number}").startswith(f"{name} ")


def test_a_command_ends_with_one_line_and_exit_code_2(capsys):
    with pytest.raises(SystemExit) as stop:
        cli.run(lambda _: parse(*GIVEN, "--legs", "0"))
    assert stop.value.code == 2
    assert capsys.readouterr().err == "error: --legs 0: must be between 1 and 100000\n"


def test_errors_after_parsing_name_options_too():
    with pytest.raises(cli.UsageError, match=r"^--seat.span has no room; see --colour$"):
        with cli.naming_options(Chair, parse(*GIVEN)):
            raise cli.ConfigError("Spring.span has no room; see Chair.colour")
    with pytest.raises(cli.AssetError, match=r"^cube.stl: too large \(--seat.span\)$"):
        with cli.naming_options(Chair, parse(*GIVEN)):
            raise cli.AssetError("cube.stl: too large (Spring.span)")


# --- help ----------------------------------------------------------------------------------------------


def test_the_short_help_has_the_commands_own_options_and_a_line_for_each_group(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    text = page(capsys, "--help")
    lines = text.splitlines()
    assert lines[0] == "usage: chair NAME [options]"
    assert "  --legs INT  [range: 1 to 100000; default: 4]" in lines
    assert "  --owner TEXT  [required]" in lines
    assert "  --colour NAME  [choices: red, blue; default: red]" in lines
    assert "  --weights FLOAT ...  [unit: kg; range: at least 0; default: 1.5 2]" in lines
    assert "  --output PATH  [default: None]" in lines
    assert "  --seat.*  The seat's springs. [4 options]" in lines
    assert "--seat.span" not in text
    assert "--help-all" in lines[-1] or "--help-all" in lines[-2]
    assert page(capsys, "-h") == text


def test_the_whole_help_and_that_of_a_group(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    whole, seat = page(capsys, "--help-all"), page(capsys, "--help-all", "seat")
    for line in (
        "--seat: The seat's springs.",
        "  --seat.span FLOAT FLOAT  [unit: m; range: -1 to 3; default: 0 1]",
        "      Shortest and longest length.",
        "  --seat.wound, --seat.no-wound  [default: on]",
        "  --seat.rest-length FLOAT  [unit: m; range: 0 to 2; default: 0.5]",
    ):
        assert line in whole.splitlines() and line in seat.splitlines()
    assert "--legs" in whole and "--legs" not in seat


def test_the_title_of_a_group_has_dashes_in_its_name_alone(capsys):
    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Bench:
        spare_seat: Spring = setting(Spring())
        """As those of `dexsim_real.run`."""

    with pytest.raises(SystemExit):
        cli.parse(Bench, ["--help-all"], prog="bench", description="")
    assert "--spare-seat: As those of `dexsim_real.run`." in capsys.readouterr().out.splitlines()


@pytest.mark.parametrize("columns", [60, 80, 100])
def test_help_keeps_to_the_terminal(capsys, monkeypatch, columns):
    monkeypatch.setenv("COLUMNS", str(columns))
    assert max(map(len, page(capsys, "--help-all").splitlines())) <= columns


def test_a_pipe_that_is_closed_is_no_error():
    """As after `--help-all | head -1`."""
    code = "from dexsim.core import cli; cli.run(lambda _: print('a' * 10**6, flush=True))"
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as child:
        child.stdout.close()
        assert child.wait() == 141 and child.stderr.read() == b""
