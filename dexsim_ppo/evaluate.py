"""Measures a policy over fixed, seeded episodes.

    python -m dexsim_ppo.evaluate grasp --episodes 1024 --seed 0

The episodes are the task's own protocol, never restarted: what counts is whether the hand still holds at the end. Their
start states are drawn by the seed; training had others. A hand that does nothing gets the same episodes: what it
achieves, too, is no achievement.
"""

import dataclasses
import functools
import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from rich.console import Console
from rich.progress import track
from rich.table import Table

from dexsim.core import cli, statistics
from dexsim.core.compilation import jit
from dexsim.core.config import Config, override, setting
from dexsim.env.evaluation import evaluation_of
from dexsim.errors import ConfigError
from dexsim_ppo.learner.networks import zero_carry
from dexsim_ppo.learner.types import Environment
from dexsim_ppo.policy import Policy, PolicyParams, act, load_policy


class Evaluator:
    """Runs evaluation episodes in compiled chunks of so many side by side, by which memory is bounded."""

    def __init__(self, env: Environment, chunk: int):
        self.env, self.chunk, self.protocol = env, chunk, evaluation_of(env)
        self._run = jit(self._episodes, backend=env.backend)
        self._plan = functools.cache(self.protocol.evaluation_plan)  # a run selects its best policy on the same ones

    def __call__(
        self, params: PolicyParams, *, episodes: int, seed: int, idle: bool = False, label: str = ""
    ) -> tuple[dict[str, Any], Any]:
        """Measure over at least `episodes` episodes, rounded up to whole chunks; with zero actions if `idle`.

        A `label` shows a progress bar of that name on standard error.

        Returns:
          The report of `summarize`, and the snapshots of the shown episodes, for `write_video`.
        """
        started, parts = time.perf_counter(), list[Any]()
        count = math.ceil(episodes / self.chunk) * self.chunk
        plan = self._plan(count, seed)
        bar = track(
            range(0, count, self.chunk),
            description=f"{label} ({count} episodes)",
            console=Console(stderr=True),
            transient=True,
            disable=not label,
        )
        for i in bar:
            part = jax.tree.map(lambda x, i=i: x[i : i + self.chunk], plan)
            parts.append(jax.device_get(self._run(params, part, idle)))
        metrics, terminated = jax.tree.map(lambda *xs: np.concatenate(xs, axis=1), *(series for series, _ in parts))
        report = summarize(self.protocol, metrics, terminated, np.asarray(plan.row))
        report |= {"seed": seed, "seconds": time.perf_counter() - started}
        return report, self._film(*parts[0][1])

    def _episodes(self, params: PolicyParams, plan: Any, idle: bool) -> tuple[Any, Any]:
        """One chunk: metrics and termination flags [T, chunk], and snapshots and termination flags [T, shown]."""
        state = self.protocol.evaluation_starts(plan)
        filmed = self._extremes(state)

        def step(carry, _):
            state, policy_carry = carry
            policy_carry, action = act(params, policy_carry, self.seen(state.obs["actor"]))
            state = jax.vmap(self.env.step)(state, jnp.where(idle, jnp.zeros_like(action), action))
            frame = jax.tree.map(lambda x: x[filmed], jax.vmap(self.protocol.snapshot)(state))
            measured = (dict(state.metrics), state.terminated), (frame, state.terminated[filmed])
            return (state, policy_carry), measured

        first: Any = state, zero_carry(params.memory, (self.chunk,))
        return jax.lax.scan(step, first, None, length=self.protocol.evaluation_steps)[1]

    def seen(self, observation: jax.Array) -> jax.Array:
        """What the policy is given of the actor's observations [chunk, n]: all, unless an experiment changes it."""
        return observation

    def _extremes(self, state: Any) -> jax.Array:
        """Two episodes [2] of a chunk: those of the lowest and the highest command, or the first and the last where
        all are equal or there is none."""
        command = getattr(jax.vmap(self.protocol.snapshot)(state), "command", jnp.zeros(self.chunk))
        command = command.reshape(self.chunk, -1).sum(-1)
        ends = jnp.stack([jnp.argmin(command), jnp.argmax(command)])
        return jnp.where(ends[0] == ends[1], jnp.array([0, self.chunk - 1]), ends)

    def _film(self, frames: Any, terminated: np.ndarray) -> Any:
        """The shown episodes one after another, each to half a second after it terminated, and a minute at most."""
        after, longest = (round(seconds / self.env.control_period) for seconds in (0.5, 60.0))
        ends = [int(np.argmax(t)) + after if t.any() else len(t) for t in terminated.T]
        ends = [min(end, longest) for end in ends]
        return jax.tree.map(lambda x: np.concatenate([x[:end, i] for i, end in enumerate(ends)]), frames)


# --- the report ---------------------------------------------------------------------------------------


def summarize(env: Any, metrics: dict[str, np.ndarray], terminated: np.ndarray, start: np.ndarray) -> dict[str, Any]:
    """Report of episodes from their metrics [T, N], termination flags [T, N] and starts [N].

    An episode lives up to, and not including, its first terminated step, whose reward belongs to the return.

    Returns:
      "held" (share of episodes never terminated), "return" and "steps_held", each with a 95 % interval by start, their
      numbers, and "task": what the task's `summarize` makes of its metrics.
    """
    steps, episodes = terminated.shape
    alive = ~np.logical_or.accumulate(terminated, axis=0)
    steps_held, starts = alive.sum(axis=0), len(np.unique(start))
    last = {name: x[np.minimum(steps_held, steps - 1), np.arange(episodes)] for name, x in metrics.items()}
    if env.evaluation == "totals":
        own = env.summarize(last, steps_held)
    else:
        # A step that diverges ends the episode: it must be counted although the episode does not survive it.
        entered = np.concatenate([np.ones((1, episodes), bool), alive[:-1]])
        masked = {name: np.where(entered if name == "non_finite" else alive, x, 0) for name, x in metrics.items()}
        own = env.summarize(masked, alive)
    independent = starts == episodes
    return {
        "episodes": episodes,
        "steps": steps,
        "starts": starts,
        "held": statistics.entry(statistics.proportion(alive[-1])) if independent else mean_interval(alive[-1], start),
        "return": mean_interval(last["return"], start),
        "steps_held": mean_interval(steps_held, start),
        "task": own,
    }


def mean_interval(x: np.ndarray, start: np.ndarray) -> dict[str, float]:
    """Mean of samples [N] with a bootstrap 95 % interval, by start [N]: samples of one start are not independent."""
    _, which = np.unique(start, return_inverse=True)
    entry = statistics.entry(statistics.ratio(np.bincount(which, x), np.bincount(which)))
    return {name: np.nan if number is None else number for name, number in entry.items()}


def print_report(report: dict[str, Any], do_nothing: dict[str, Any] | None, *, title: str) -> None:
    """A table of the report's headline, and beside it that of a hand that does nothing, if it was measured."""
    idle = do_nothing and headline(do_nothing)
    table = Table("measure", "policy", "95 % interval", *(["doing nothing"] if idle else []), title=title)
    for name, entry in headline(report).items():
        low, high = (written(entry | {"value": entry.get(end)}) for end in ("low", "high"))
        beside = [written(idle.get(name, {"value": None}))] if idle else []
        table.add_row(name, written(entry), f"{low} .. {high}" if entry.get("high") is not None else "", *beside)
    Console().print(table)
    print(f"{report['episodes']} episodes of {report['steps']} steps, seed {report['seed']}, {report['seconds']:.1f} s")


def written(entry: dict[str, Any]) -> str:
    """A headline's number with its unit; a share [0, 1] in per cent."""
    value, unit = entry["value"], entry.get("unit", "")
    if value is None:
        return "-"
    return f"{100 * value:.1f} %" if unit == "%" else f"{value:.3g} {unit}".rstrip()


def headline(report: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Names of the task's headline, or else the share held, and the return: value, low, high and unit."""
    own = report["task"].get("headline") or {"held": report["held"] | {"unit": "%"}}
    rows = {name: entry if isinstance(entry, dict) else {"value": entry} for name, entry in own.items()}
    return rows | {"return": report["return"]}


# --- from Python and as a command -----------------------------------------------------------------------


def write_video(env: Environment, snapshots: Any, path: Path, quality: str = "quick") -> Path:
    """Render an evaluation's snapshots; returns the file written, a GIF's where MP4 cannot be.

    `quality` "quick" is 640 x 480 with 200 frames, but eight a second at least; "talk" is 1920 x 1080 with 30 a second.
    """
    from dexsim.render.render import render_episode

    if not jax.tree.leaves(snapshots):
        raise ConfigError(f"--video {path}: {env.name!r} cannot be drawn")
    fps = 1.0 / env.control_period
    seconds = jax.tree.leaves(snapshots)[0].shape[0] / fps
    # At fewer than eight pictures a second a gait cannot be followed.
    size, rate = ((1920, 1080), 30.0) if quality == "talk" else ((640, 480), min(max(200 / seconds, 8.0), fps))
    return Path(render_episode(env, snapshots, path, fps, size=size, rate=rate))


def evaluate_policy(
    policy: Policy | str | Path, *, episodes: int = 0, seed: int = 0, env: Environment | None = None
) -> dict[str, Any]:
    """Measure a policy over fixed, seeded episodes.

    Args:
      policy: a policy, its file, or the name of a shipped one.
      episodes: how many, rounded up to whole chunks; 0 chooses by the device and the length of an episode.
      seed: of the episodes.
      env: where to measure it; None for the environment that it was trained in. Another one is warned of.

    Returns:
      The report: `"held"`, `"return"`, `"steps_held"` with 95 % intervals, `"task"`: the task's own figures, and
      `"do_nothing"`: the same of a hand that does nothing.

    Raises:
      CheckpointError, ConfigError: see `load_policy` and `Policy.make_env`.
    """
    policy = policy if isinstance(policy, Policy) else load_policy(policy)
    if env is None:
        env = policy.make_env()
    else:
        policy.check_env(env)
    return _measure(policy, env, episodes, seed, chunk=0, baseline=True)[0]


@dataclasses.dataclass(frozen=True, kw_only=True)
class EvaluateArguments(Config):
    """Measure a policy over fixed, seeded episodes."""

    policy: Annotated[str, tyro.conf.Positional]
    """A policy file, or the name of a shipped policy, such as grasp."""
    episodes: int = setting(0, unit="1", low=0, high=1_000_000)
    """Evaluation episodes, rounded up to whole chunks. 0: 1024 on a GPU; on a CPU 448 of grasp, 64 of rotate."""
    seed: int = setting(0, unit="1", low=0, high=2**32 - 2)
    """Seed of the episodes and their start states. Training selects its best policy by episodes of another."""
    backend: Literal["auto", "c", "cuda", "mjx"] = setting("auto")
    """Physics backend. auto: c on a CPU, cuda on an NVIDIA GPU, otherwise mjx."""
    chunk: int = setting(0, unit="1", low=0, high=65536)
    """Episodes simulated side by side; 0 chooses by the device."""
    seconds: float = setting(0.0, unit="s", low=0.0)
    """Length of an evaluation episode; 0 for the task's own."""
    task: str = ""
    """Module and name of a task of your own, such as my_module:poke; the policy's file names all others."""
    hand: str = ""
    """The TOML of a hand of your own, where it is not in the place that the policy's file names; a changed file of the
    same joints, fingers and taxels is warned of."""
    baseline: bool = True
    """Measure a hand that does nothing on the same episodes, too, which doubles the time."""
    ablate: tuple[str, ...] = ()
    """Observation fields, such as contact_force contact_centre, to replace by their training mean; those of a fixed
    scale, such as touch, become 0."""
    set: tuple[str, ...] = ()
    """Change fields of the task's configuration, such as randomization.extremes=1 edge=[0.05,0.05]."""
    output: Path | None = None
    """File for the report, as JSON; None writes no report."""
    video: Path | None = None
    """File for a video of the lowest and the highest command, MP4 or GIF; None renders no video."""
    video_quality: Literal["quick", "talk"] = setting("quick")
    """quick: 640 x 480 and few frames. talk: 1920 x 1080 at 30 frames a second, which takes minutes."""


def _measure(
    policy: Policy, env: Environment, episodes: int, seed: int, chunk: int, baseline: bool, label: str = ""
) -> tuple[dict, Any]:
    """The report, with that of a hand that does nothing, and the film; on a CPU by default of as many episodes as about
    a minute suffices for."""
    gpu = jax.default_backend() == "gpu"
    chunk = min(chunk or (1024 if gpu else 64), episodes or 1024)
    enough = 1024 if gpu else 64 * int(np.clip(2000 / evaluation_of(env).evaluation_steps, 1, 16))
    measure = functools.partial(Evaluator(env, chunk), policy.params, episodes=episodes or enough, seed=seed)
    report, film = measure(label=label)
    if baseline:
        report["do_nothing"], _ = measure(idle=True, label=label and "doing nothing")
    return report | {"backend": env.backend}, film


def main(argv: Sequence[str] | None = None) -> int:
    """The command. Returns its exit code."""
    arguments = cli.parse(EvaluateArguments, argv)
    cli.enable_caches()
    outputs = {"--output": arguments.output, "--video": arguments.video}
    for path in filter(None, outputs.values()):
        cli.check_writable(path)
    cli.check_no_overwrite(outputs, {"policy": arguments.policy})
    policy = load_policy(arguments.policy, task=arguments.task).ablate(*arguments.ablate)
    seconds = [f"evaluation_seconds={arguments.seconds}"] if arguments.seconds else []
    policy = dataclasses.replace(policy, env_config=override(policy.env_config, (*seconds, *arguments.set)))
    env = policy.make_env(backend=arguments.backend, hand=policy.find_hand(arguments.hand))
    settings = arguments.episodes, arguments.seed, arguments.chunk, arguments.baseline
    report, snapshots = _measure(policy, env, *settings, label=arguments.policy)
    report |= {"policy": arguments.policy, "ablate": list(arguments.ablate), "set": list(arguments.set)}
    report |= {"hand": arguments.hand or None} | cli.environment_report()
    # First the table: a full disk must not cost what was measured.
    print_report(report, report.get("do_nothing"), title=f"{policy.task}: {arguments.policy}")
    if arguments.output:
        cli.write_json(arguments.output, report)
    if arguments.video:
        print(f"video: {write_video(env, snapshots, arguments.video, arguments.video_quality)}")
    return 0


if __name__ == "__main__":
    cli.run(main)
