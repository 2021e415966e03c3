"""A run whose environment gives NaN: it is shown, and ends with the truth about its checkpoints."""

import dataclasses

import jax.numpy as jnp
import pytest
import tiny_train
from tiny_env import TinyEnv

from dexsim.core.errors import DexsimError
from dexsim_ppo import train
from dexsim_ppo.training.runlog import RunFolder

QUICK = [*tiny_train.QUICK, *"--ppo.minibatches 2 --ppo.epochs 1 --seed 3 --log-every 1".split()]
GOOD_ITERATIONS = 3


class Breaks(TinyEnv):
    """From its 24th step on, the actors of environments that started on the right side observe NaN."""

    def _start(self, key):
        state = super()._start(key)
        return dataclasses.replace(state, metrics=state.metrics | {"age": jnp.float32(0)})

    def randomize_episode_time(self, state, key):
        return state

    def step(self, state, action):
        age = state.metrics["age"] + 1
        state = super().step(state, action)
        broken = (age >= 8 * GOOD_ITERATIONS) & (state.target > 0.0)
        actor = state.obs["actor"].at[1].set(jnp.where(broken, jnp.nan, state.obs["actor"][1]))
        return dataclasses.replace(
            state,
            obs=state.obs | {"actor": actor},
            truncated=jnp.bool_(False),
            terminated=jnp.bool_(False),
            metrics=state.metrics | {"age": age},
        )


def test_a_run_that_diverges_ends_and_names_what_is_from_before(tmp_path, monkeypatch, capsys):
    """By then the newest checkpoints hold the fault: only those up to the last sound iteration are named."""
    tiny_train.install(monkeypatch, Breaks)
    folder = RunFolder(tmp_path / "run")
    options = ["--minutes", "5", "--run-dir", str(folder.path), "--checkpoint-every", "1", "--keep-checkpoints"]
    with pytest.raises(DexsimError, match=f"after iteration {GOOD_ITERATIONS}; no checkpoint is from before"):
        train.main([*QUICK, *options, "3"])
    shown = capsys.readouterr().out
    assert f"iteration {GOOD_ITERATIONS + 1}: " in shown and "updates skipped" in shown
    assert shown.count("gradient is not finite") == 1, "said when it begins"
    assert min(int(path.stem) for path in folder.existing_checkpoints()) > GOOD_ITERATIONS
    options[3] = str(tmp_path / "other")
    with pytest.raises(DexsimError, match=f"newest checkpoint from before is .*{GOOD_ITERATIONS}.msgpack"):
        train.main([*QUICK, *options, "9"])
