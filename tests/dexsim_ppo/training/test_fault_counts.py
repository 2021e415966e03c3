"""When a call's skipped updates are shown, kept and fatal: the counting alone, over a folder that writes nothing."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from dexsim.core.errors import DexsimError
from dexsim_ppo.training.faults import DIVERGED_AFTER, Faults

CONFIG = SimpleNamespace(iterations_per_call=2, epochs=3, minibatches=4)  # 24 updates a call, 12 an iteration


@pytest.fixture
def run(tmp_path):
    """`run(skipped, iteration, **metrics)` checks a call; `.notes` and `.saved` are what it showed and wrote."""
    saved, notes = [], []
    checkpoints = [Path(f"{number:08d}.msgpack") for number in (6, 8, 10)]
    folder = SimpleNamespace(path=tmp_path, existing_checkpoints=lambda: checkpoints)
    start = SimpleNamespace(skipped_updates=100, iteration=6)
    faults = Faults(CONFIG, folder, "grasp", start, lambda path, state: saved.append(path))

    def check(skipped, iteration, **metrics):
        metrics = {"skipped_updates": np.array([0, skipped]), **metrics}
        return faults.check(SimpleNamespace(iteration=iteration - 2), metrics, iteration, notes.append)

    check.saved, check.notes = saved, notes
    return check


def test_what_was_skipped_before_a_resume_is_no_fault(run):
    assert run(100, 8) == {
        "skipped_updates": 100,
        "updates": 96,
        "total/nonfinite_rewards": 0,
        "total/bounded_rewards": 0,
    }
    assert not run.notes and not run.saved


def test_a_fault_is_noted_once_until_a_clean_call(run):
    for iteration, skipped in ((8, 105), (10, 106), (12, 106), (14, 107)):
        run(skipped, iteration)
    assert [note.split(":")[0] for note in run.notes] == ["iteration 8", "iteration 14"]
    assert "iteration 8: 5 of 24 updates skipped" in run.notes[0] and str(run.saved[0]) in run.notes[0]
    assert [path.name for path in run.saved] == ["reproduce-00000006.msgpack"], "the first alone"


def test_half_of_the_updates_may_be_skipped(run):
    for call in range(1, 3 * DIVERGED_AFTER):  # half of them may be skipped for ever
        run(100 + 12 * call, 6 + 2 * call)


def test_more_than_half_ends_the_run(run):
    run(100, 8)
    for call in range(1, DIVERGED_AFTER):
        run(100 + 13 * call, 8 + 2 * call)
    with pytest.raises(DexsimError, match=r"the first one after iteration 8;.* before is 00000008.msgpack"):
        run(100 + 13 * DIVERGED_AFTER, 8 + 2 * DIVERGED_AFTER)


def test_faulty_rewards_add_up_over_the_calls(run):
    run(100, 8, nonfinite_rewards=np.array([1.0, 2.0]))
    totals = run(100, 10, nonfinite_rewards=np.array([4.0, 0.0]), bounded_rewards=np.array([0.5, 0.5]))
    assert totals["total/nonfinite_rewards"] == 7 and totals["total/bounded_rewards"] == 1
