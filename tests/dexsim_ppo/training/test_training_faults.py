"""A run whose environment gives NaN: it is shown, replayed from a file, and told the truth about."""

import dataclasses
import re

import jax.numpy as jnp
import pytest
import tiny_train
from tiny_env import TinyConfig, TinyEnv

from dexsim.core.errors import DexsimError
from dexsim_ppo import checkpoint, reproduce, train
from dexsim_ppo.training.runlog import RunFolder

QUICK = [*tiny_train.QUICK, *"--ppo.minibatches 2 --ppo.epochs 1 --seed 3 --log-every 1".split()]
GOOD_ITERATIONS = 3


class Breaks(TinyEnv):
    """From its 24th step on, the actors of environments that started on the right side observe NaN."""

    share = 0.0

    def _start(self, key):
        state = super()._start(key)
        return dataclasses.replace(state, metrics=state.metrics | {"age": jnp.float32(0)})

    def randomize_episode_time(self, state, key):
        return state

    def step(self, state, action):
        age = state.metrics["age"] + 1
        state = super().step(state, action)
        broken = (age >= 8 * GOOD_ITERATIONS) & (state.target > self.share)
        actor = state.obs["actor"].at[1].set(jnp.where(broken, jnp.nan, state.obs["actor"][1]))
        return dataclasses.replace(
            state,
            obs=state.obs | {"actor": actor},
            truncated=jnp.bool_(False),
            terminated=jnp.bool_(False),
            metrics=state.metrics | {"age": age},
        )


def install(patch, env_class):
    def make(task, config=None, *, backend="auto", **_):
        return env_class(config or TinyConfig(), backend=backend)

    tiny_train.install(patch)
    patch.setattr("dexsim.registry.make", make)
    patch.setattr("dexsim.make", make, raising=False)


@pytest.fixture
def diverged(tmp_path, monkeypatch, capsys):
    """Folder, error and output of a run that diverges."""
    install(monkeypatch, Breaks)
    folder = RunFolder(tmp_path / "run")
    with pytest.raises(DexsimError) as error:
        train.main([*QUICK, "--minutes", "5", "--run-dir", str(folder.path), "--checkpoint-every", "1"])
    return folder, str(error.value), capsys.readouterr().out


def test_the_error_names_a_checkpoint_that_is_from_before(diverged):
    """By then the newest checkpoints hold the fault: only those up to the last sound iteration are named."""
    folder, error, _ = diverged
    kept = [int(path.stem) for path in folder.existing_checkpoints()]
    assert min(kept) > GOOD_ITERATIONS, "this run has kept no sound checkpoint"
    assert "no checkpoint is from before" in error and "\n" not in error
    assert f"after iteration {GOOD_ITERATIONS}" in error


@pytest.mark.slow
def test_the_fault_can_be_replayed(diverged, capsys):
    folder, error, shown = diverged
    (file,) = folder.path.glob("reproduce-*.msgpack")
    command = f"python -m dexsim_ppo.reproduce {file}"
    assert command in error and command in shown.replace("\n", "")
    saved = checkpoint.load(file, kind="train", task="tiny")
    assert int(saved.leaves[".iteration"]) == GOOD_ITERATIONS and saved.content["arguments"]["seed"] == 3
    assert reproduce.main([str(file)]) == 0
    out = capsys.readouterr().out
    assert re.search(rf"iteration {GOOD_ITERATIONS}: [12] of 2 gradients are not finite", out)
    assert re.search(r"actor observation 'target': \d+ of 16 environments \([\d, ]+\), first at step 0", out)
    # What follows from it comes later: the integrator takes the NaN action that the policy makes of it.
    assert re.search(r"critic observation 'position': .* first at step 1", out)
    assert "critic observation 'target'" not in out
