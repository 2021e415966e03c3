"""Measures a policy over fixed, seeded episodes.

    python -m dexsim_ppo.evaluate grasp --episodes 1024 --seed 0

The policy is a file, or the name of a shipped one. The episodes are the task's own protocol
(`env.evaluation_plan`), never restarted: what counts is whether the hand still holds at the end. Their start states
are drawn for this evaluation by its seed; training had others. Beside the policy a hand that does nothing gets the
same episodes: what it achieves, too, is no achievement.
"""

import dataclasses
import functools
import math
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from dexsim.core import cli, statistics
from dexsim.core.compilation import collector_paused, jit
from dexsim.core.config import override, setting, validate
from dexsim.core.options import Option
from dexsim.registry import find_task
from dexsim_ppo.learner.types import Environment
from dexsim_ppo.policy import Policy, PolicyParams, act, load_policy


class Evaluator:
    """Runs evaluation episodes in compiled chunks, so that memory is bounded by the chunk.

    Args:
      env: the environment.
      chunk: episodes run side by side.
    """

    # The task spreads its commands over a chunk, so its first and last episode show the two ends.
    SHOWN = (0, -1)
    SHOWN_SECONDS = 60.0

    def __init__(self, env: Environment, chunk: int):
        self.env, self.chunk = env, chunk
        self.totals = env.evaluation == "totals"
        self._run, self._plans = jit(self._episodes, backend=env.backend), dict[tuple[int, int], Any]()

    def __call__(
        self, params: PolicyParams, *, episodes: int, seed: int, idle: bool = False
    ) -> tuple[dict[str, Any], Any]:
        """Measure over at least `episodes` episodes, rounded up to whole chunks; with zero actions if `idle`.

        Returns:
          The report: `"held"` (share of episodes never terminated), `"return"` and `"steps_held"`, each
          with a 95 % interval by start, and `"task"`: what the task's `summarize` makes of its
          metrics. And the snapshots of the shown episodes, for `write_video`.
        """
        started, chunks = time.perf_counter(), math.ceil(episodes / self.chunk)
        plan = self._plan(chunks * self.chunk, seed)
        with collector_paused():
            parts = [
                jax.device_get(self._run(params, jax.tree.map(lambda x, i=i: x[i : i + self.chunk], plan), idle))
                for i in range(0, chunks * self.chunk, self.chunk)
            ]
        # Episodes are the last axis of all that is measured.
        measured = jax.tree.map(lambda *xs: np.concatenate(xs, axis=-1), *(measured for measured, _ in parts))
        found, over = measured
        report = (summarize_totals if self.totals else summarize)(self.env, found, over, np.asarray(plan.row)) | {
            "seed": seed,
            "seconds": time.perf_counter() - started,
        }
        return report, self._film(*parts[0][1])

    def _plan(self, count: int, seed: int) -> Any:
        """The episodes; kept, since a run selects its best policy on the same ones again and again."""
        if (count, seed) not in self._plans:
            self._plans[count, seed] = self.env.evaluation_plan(count, seed)
        return self._plans[count, seed]

    def _episodes(self, params: PolicyParams, plan: Any, idle: bool):
        """One chunk: what the report needs, and snapshots and termination flags [T, shown].

        The report needs metrics and termination flags [T, chunk]; of long episodes, whose task keeps its
        own totals, only the metrics of each one's last tick [chunk] and the ticks it lived [chunk].
        """
        shown = jnp.array(self.SHOWN)

        def step(carry, _):
            state, last = carry
            action = act(params, state.obs["actor"])
            state = jax.vmap(self.env.step)(state, jnp.where(idle, jnp.zeros_like(action), action))
            frame = jax.tree.map(lambda x: x[shown], jax.vmap(self.env.snapshot)(state))
            series = (dict(state.metrics), state.terminated)
            film = (frame, state.terminated[shown])
            if not self.totals:
                return (state, None), (series, film)
            return (state, _follow(last, *series)), (None, film)

        state = self.env.evaluation_starts(plan)
        last: Any = None
        if self.totals:
            last = (dict(state.metrics), jnp.zeros(self.chunk, jnp.int32), jnp.zeros(self.chunk, bool))
        (_, last), (series, film) = jax.lax.scan(step, (state, last), None, length=self.env.evaluation_steps)
        return (last[:2] if self.totals else series), film

    def _film(self, frames: Any, terminated: np.ndarray) -> Any:
        """The shown episodes one after another, each to half a second after it terminated."""
        after, longest = (round(s / self.env.control_period) for s in (0.5, self.SHOWN_SECONDS))
        ends = [int(np.argmax(t)) + after if t.any() else len(t) for t in terminated.T]
        ends = [min(end, longest) for end in ends]
        return jax.tree.map(lambda x: np.concatenate([x[:end, i] for i, end in enumerate(ends)]), frames)


def summarize(
    env: Environment, metrics: dict[str, np.ndarray], terminated: np.ndarray, start: np.ndarray
) -> dict[str, Any]:
    """Report of episodes from their metrics `[T, N]`, termination flags `[T, N]` and starts `[N]`.

    An episode lives up to, and not including, its first terminated step. That step's reward belongs to
    the return, and nothing after it counts.
    """
    steps, episodes = terminated.shape
    alive = ~np.logical_or.accumulate(terminated, axis=0)
    steps_held = alive.sum(axis=0)
    last = np.minimum(steps_held, steps - 1)
    returns = metrics["return"][last, np.arange(episodes)]
    masked = {name: np.where(alive, values, 0) for name, values in metrics.items()}
    return {
        "episodes": episodes,
        "steps": steps,
        **_intervals(alive[-1], returns, steps_held, start),
        "task": env.summarize(masked, alive),
    }


def summarize_totals(
    env: Environment, metrics: dict[str, np.ndarray], lived: np.ndarray, start: np.ndarray
) -> dict[str, Any]:
    """Report of episodes from the metrics of their last tick [N], the ticks they lived [N] and their starts [N]."""
    held = lived == env.evaluation_steps
    return {
        "episodes": int(lived.size),
        "steps": env.evaluation_steps,
        **_intervals(held, metrics["return"], lived, start),
        "task": env.summarize(metrics, lived),
    }


def _intervals(held: np.ndarray, returns: np.ndarray, lived: np.ndarray, start: np.ndarray) -> dict[str, Any]:
    """What every report has, of episodes [N]: how many starts they had, and the figures with intervals by start."""
    starts = len(np.unique(start))
    share = proportion(held) if starts == held.size else mean_interval(held.astype(float), start)
    share |= {"low": max(share["low"], 0.0), "high": min(share["high"], 1.0)}
    return {
        "starts": starts,
        "held": share,
        "return": mean_interval(returns, start),
        "steps_held": mean_interval(lived, start),
    }


def _follow(last: tuple, metrics: dict[str, jax.Array], terminated: jax.Array) -> tuple:
    """`last` (metrics, ticks lived, whether ended), one tick later; an ended episode stays as it is."""
    before, lived, ended = last
    kept = jax.tree.map(lambda old, new: jnp.where(ended, old, new), before, metrics)
    ended = ended | terminated
    return kept, lived + (~ended).astype(jnp.int32), ended


def mean_interval(x: np.ndarray, start: np.ndarray) -> dict[str, float]:
    """Mean of samples [N] with its normal 95 % interval, by start [N]: samples of one start are not independent."""
    _, which = np.unique(start, return_inverse=True)
    mean, starts = float(np.mean(x)), int(which.max()) + 1
    off = np.bincount(which, np.asarray(x, float) - mean)
    half = 1.96 * float(np.sqrt(np.sum(off**2) * starts / max(starts - 1, 1))) / x.size
    return {"value": mean, "low": mean - half, "high": mean + half}


def proportion(x: np.ndarray) -> dict[str, float]:
    """Share of true samples with its Wilson 95 % interval."""
    share = statistics.proportion(x)
    return {"value": share["mean"], "low": share["low"], "high": share["high"]}


def write_video(env: Environment, snapshots: Any, path: Path) -> Path:
    """Render an evaluation's snapshots; returns the file written, a GIF's where MP4 cannot be."""
    from dexsim.render.render import render_episode

    ticks = jax.tree.leaves(snapshots)[0].shape[0]
    # Eight pictures a second at least, or a gait cannot be followed.
    frames = max(400, round(8 * ticks * env.control_period))
    return Path(render_episode(env, snapshots, path, 1.0 / env.control_period, max_frames=frames))


def default_chunk() -> int:
    """Episodes run side by side on the device found."""
    return 1024 if jax.default_backend() == "gpu" else 64


def evaluate_policy(
    policy: Policy | str | Path,
    *,
    episodes: int = 1024,
    seed: int = 0,
    env: Environment | None = None,
    backend: str = "auto",
    chunk: int = 0,
    baseline: bool = True,
) -> dict[str, Any]:
    """Measure a policy over fixed, seeded episodes.

    Args:
      policy: a policy, its file, or the name of a shipped one.
      episodes: how many, rounded up to whole chunks.
      seed: of the episodes.
      env: where to measure it; None for the environment that it was trained in. Another one is warned of.
      backend: physics, where `env` is None.
      chunk: episodes run side by side; 0 chooses by the device.
      baseline: measure a hand that does nothing on the same episodes, too, which doubles the time.

    Returns:
      The report: `"held"`, `"return"`, `"steps_held"` with 95 % intervals, `"task"`: the task's own figures, and
      `"do_nothing"`: the same of the baseline.

    Raises:
      CheckpointError, ConfigError: see `Policy.load` and `Policy.make_env`.
    """
    policy = policy if isinstance(policy, Policy) else load_policy(policy)
    chunk = min(chunk or default_chunk(), episodes)
    if env is None:
        env = policy.make_env(backend=backend, num_envs=chunk)
    else:
        policy.check_env(env)
    evaluator = Evaluator(env, chunk)
    report, _ = evaluator(policy.params, episodes=episodes, seed=seed)
    if baseline:
        report["do_nothing"], _ = evaluator(policy.params, episodes=episodes, seed=seed, idle=True)
    return report | {"backend": env.backend}


@dataclass(frozen=True, kw_only=True)
class EvaluateArguments:
    """Options of `python -m dexsim_ppo.evaluate`."""

    policy: Annotated[str, tyro.conf.Positional]
    """A policy file, or the name of a shipped policy, such as grasp."""
    episodes: int = setting(1024, unit="1", low=1)
    """Evaluation episodes, rounded up to whole chunks."""
    seed: int = setting(0, unit="1", low=0, high=2**32 - 2)
    """Seed of the episodes and their start states. Training selects its best policy by episodes of another."""
    backend: Literal["auto", "jax", "warp", "c"] = setting("auto")
    """Physics backend. auto: c on a CPU, warp on an NVIDIA GPU if it is installed, otherwise jax."""
    chunk: int = setting(0, unit="1", low=0)
    """Episodes simulated side by side; 0 chooses by the device."""
    seconds: float = setting(0.0, unit="s", low=0.0)
    """Length of an evaluation episode; 0 for the task's own."""
    task: str = ""
    """Module and name of a task of your own, such as my_module:poke; the policy's file names all others."""
    baseline: bool = True
    """Measure a hand that does nothing on the same episodes, too, which doubles the time."""
    ablate: tuple[str, ...] = ()
    """Observation fields to replace by their training mean, such as contact_force contact_centre."""
    set: tuple[str, ...] = ()
    """Change fields of the task's configuration, such as randomization.extremes=1 edge=[0.05,0.05]."""
    output: Path | None = None
    """File for the report, as JSON; None writes no report."""
    video: Path | None = None
    """File for a video of the first and the last command (MP4 or GIF); None renders no video."""

    def __post_init__(self) -> None:
        validate(self)


def main(argv: Sequence[str] | None = None) -> int:
    """The command. Returns its exit code."""
    arguments = cli.parse(
        EvaluateArguments,
        sys.argv[1:] if argv is None else argv,
        prog="python -m dexsim_ppo.evaluate",
        description="Measure a policy over fixed, seeded episodes.",
    )
    cli.enable_caches()
    policy = load_policy(arguments.policy).ablate(*arguments.ablate)
    if arguments.task:
        find_task(arguments.task)
    chunk = min(arguments.chunk or default_chunk(), arguments.episodes)
    if not any(entry.startswith("objects.mesh=") for entry in arguments.set):
        policy.check_mesh()
    seconds = [f"evaluation_seconds={arguments.seconds}"] if arguments.seconds else []
    policy = dataclasses.replace(policy, env_config=override(policy.env_config, (*seconds, *arguments.set)))
    entry = find_task(policy.task)
    with cli.naming_options(entry.config_class, entry.config(), functools.partial(_typed, arguments)):
        env = policy.build_env(backend=arguments.backend, num_envs=chunk)
    evaluator = Evaluator(env, chunk)
    measure = functools.partial(evaluator, policy.params, episodes=arguments.episodes, seed=arguments.seed)
    report, snapshots = measure()
    if arguments.baseline:
        report["do_nothing"], _ = measure(idle=True)
    report |= {"policy": arguments.policy, "ablate": list(arguments.ablate), "set": list(arguments.set)}
    report |= {"backend": env.backend} | cli.environment_report()
    if arguments.output:
        cli.write_json(arguments.output, report)
    print_report(report, report.get("do_nothing"), title=f"{policy.task}: {arguments.policy}")
    if arguments.video:
        print(f"video: {write_video(env, snapshots, arguments.video)}")
    return 0


def _typed(arguments: EvaluateArguments, field: Option) -> str | None:
    """What was typed before the value of a field of the task's configuration; None if it is the file's."""
    path = ".".join(field.path)
    if any(entry.partition("=")[0] == path for entry in arguments.set):
        return f"--set {path}="
    return "--seconds " if path == "evaluation_seconds" and arguments.seconds else None


def print_report(report: dict[str, Any], do_nothing: dict[str, Any] | None, *, title: str) -> None:
    """A table of the report's headline, and beside it that of a hand that does nothing, if it was measured."""
    from rich.console import Console
    from rich.table import Table

    idle = do_nothing and _headline(do_nothing)
    table = Table("measure", "value", "95 % interval", *(["doing nothing"] if idle else []), title=title)
    for name, entry in _headline(report).items():
        low, high = entry.get("low"), entry.get("high")
        span = "" if low is None or high is None else f"{low:.4g} .. {high:.4g}"
        beside = [_number(idle.get(name, {}).get("value"))] if idle else []
        table.add_row(name, _number(entry["value"]), span, *beside)
    Console().print(table)
    print(f"{report['episodes']} episodes of {report['steps']} steps, seed {report['seed']}, {report['seconds']:.1f} s")


def _headline(report: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Names of the task's headline, or else the share held, and the return: value, low and high."""
    headline = report["task"].get("headline") or {"held": report["held"]}
    rows = {name: entry if isinstance(entry, dict) else {"value": entry} for name, entry in headline.items()}
    return rows | {"return": report["return"]}


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.4g}"


if __name__ == "__main__":
    cli.run(main)
