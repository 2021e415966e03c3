"""When a call's skipped updates are shown, kept and fatal: the counting alone, over a folder that writes nothing."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from dexsim.core.errors import DexsimError
from dexsim_ppo.training import processes
from dexsim_ppo.training.faults import DIVERGED_AFTER, KEPT, Faults

CONFIG = SimpleNamespace(iterations_per_call=2, epochs=3, minibatches=4)  # 24 updates a call, 12 an iteration


@pytest.fixture
def run(tmp_path, monkeypatch):
    """`run(skipped, iteration, **metrics)` checks a call; `.notes` and `.saved` are what it showed and wrote."""
    saved, notes = [], []
    monkeypatch.setattr(processes, "save", lambda path, **content: saved.append((path, content)))
    checkpoints = [Path(f"{number:08d}.msgpack") for number in (6, 8, 10)]
    folder = SimpleNamespace(path=tmp_path, existing_checkpoints=lambda: checkpoints)
    start = SimpleNamespace(skipped_updates=100, iteration=6)
    faults = Faults(CONFIG, folder, {"task": "grasp", "seed": 1}, start)

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


def test_a_note_names_the_updates_of_the_call(run):
    run(105, 8)
    assert "iteration 8: 5 of 24 updates skipped" in run.notes[0]
    path, content = run.saved[0]
    assert path.name == "reproduce-00000006.msgpack" and str(path) in run.notes[0]
    assert content["kind"] == "reproducer" and content["task"] == "grasp"
    assert content["content"] == {"task": "grasp", "seed": 1, "lost": 5}


def test_a_fault_is_noted_once_until_a_clean_call(run):
    for iteration, skipped in ((8, 101), (10, 102), (12, 102), (14, 103)):
        run(skipped, iteration)
    assert [note.split(":")[0] for note in run.notes] == ["iteration 8", "iteration 14"]


def test_only_the_first_reproducers_are_kept(run):
    for number in range(KEPT + 2):
        run(101 + number, 8 + 4 * number)
        run(101 + number, 10 + 4 * number)
    assert len(run.notes) == KEPT + 2 and len(run.saved) == KEPT
    assert "replay" not in run.notes[-1]


def test_half_of_the_updates_may_be_skipped_for_ever(run):
    for call in range(1, 3 * DIVERGED_AFTER):
        run(100 + 12 * call, 6 + 2 * call)


def test_more_than_half_ends_the_run_after_some_calls_in_a_row(run):
    run(100, 8)
    for call in range(1, DIVERGED_AFTER):
        run(100 + 13 * call, 8 + 2 * call)
    with pytest.raises(DexsimError, match=r"the first one after iteration 8;.* before is 00000008.msgpack"):
        run(100 + 13 * DIVERGED_AFTER, 8 + 2 * DIVERGED_AFTER)


def test_one_better_call_starts_the_count_anew(run):
    skipped = 100
    for call in range(1, 2 * DIVERGED_AFTER):
        skipped += 1 if call == DIVERGED_AFTER else 13
        run(skipped, 6 + 2 * call)


def test_faulty_rewards_add_up_over_the_calls(run):
    run(100, 8, nonfinite_rewards=np.array([1.0, 2.0]))
    totals = run(100, 10, nonfinite_rewards=np.array([4.0, 0.0]), bounded_rewards=np.array([0.5, 0.5]))
    assert totals["total/nonfinite_rewards"] == 7 and totals["total/bounded_rewards"] == 1


def test_a_full_disk_does_not_end_the_run(run, monkeypatch):
    def full(path, **content):
        raise OSError(28, "No space left")

    monkeypatch.setattr(processes, "save", full)
    run(101, 8)
    assert "could not be written (No space left)" in run.notes[0] and "replay" not in run.notes[0]
