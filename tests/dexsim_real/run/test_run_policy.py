"""A run as one call, on a scripted hand over a pseudo-terminal."""

import pytest

pytest.importorskip("serial")
from following_hand import FollowingHand

import dexsim_real
from dexsim.core.errors import ConfigError
from dexsim_real.core.log import Kind, LogReader
from dexsim_real.wire.link import LinkConfig

QUICK = LinkConfig(settle=0.0, paced=False, margin=0.2)

pytestmark = pytest.mark.usefixtures("jax_as_it_is")


def run(peer, folder, **options):
    return dexsim_real.run_policy(
        "grasp",
        peer.port,
        seconds=0.5,
        yes=True,
        fixed_object=True,
        approach=0.4,
        guard=False,
        realtime=False,
        quiet=True,
        link=QUICK,
        safety=dexsim_real.SafetyConfig(stale=1.0),
        log=folder / "run.log",
        **options,
    )


def test_one_call_runs_a_policy_and_says_how_it_went(tmp_path):
    with FollowingHand() as peer:
        result = run(peer, tmp_path, command=0.7)
        assert peer.on().any() and not peer.on()[-1]
    assert (result.end, result.code, result.problem) == ("time is over", 0, "") and result.summary["motors_off"]
    assert result.summary["seconds"] >= 0.5 and result.summary["command"] == 0.7
    assert result.log == tmp_path / "run.log"
    ticks = [record for record in LogReader(result.log) if record.kind == Kind.TICK]
    assert len(ticks) > 5


def test_a_wrong_option_moves_nothing(tmp_path):
    with FollowingHand() as peer:
        with pytest.raises(ConfigError, match="RunArguments.command = 2"):
            run(peer, tmp_path, command=2.0)
        assert not peer.commands
