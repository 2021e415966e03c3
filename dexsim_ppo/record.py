"""Records simulated episodes of a policy for other programs.

    python -m dexsim_ppo.record grasp --lerobot data/grasp --episodes 16 --pictures
    python -m dexsim_ppo.record rotate --rrd rotate.rrd --episodes 1
    python -m dexsim_ppo.record grasp --npz assets/episodes/grasp.npz --episodes 4    # what `dexsim demo` shows

A dataset holds what the hand's own sensors measured, as a log of a run on a hand does; `python -m dexsim_real.replay`
writes the same formats from such a log. An .npz holds what the live view draws, true poses included.
"""

import dataclasses
import io
import operator
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import jax
import numpy as np
import tyro
from PIL import Image

from dexsim.core import cli
from dexsim.core.compilation import jit
from dexsim.core.config import Config, setting
from dexsim.core.install import require
from dexsim.datasets.episodes import Episodes, write_episodes
from dexsim.datasets.lerobot import READINGS, Trajectory, check_lerobot, write_lerobot
from dexsim.datasets.rerun import show_rerun
from dexsim.env.evaluation import evaluation_of
from dexsim.errors import ConfigError
from dexsim.hand.mjcf import hand_poses
from dexsim.render.picture import draw_scene
from dexsim.render.render import camera_of
from dexsim.render.snapshot import Snapshot
from dexsim_ppo.policy import Policy, act, load_policy

_PICTURE = (320, 240)  # pixels


def record(
    policy: Policy, env: Any, *, episodes: int, seconds: float, seed: int
) -> tuple[list[Trajectory], list[Snapshot]]:
    """Trajectories of the first episodes of the task's evaluation, each until it ends or `seconds` are over, and what a
    picture of each of their ticks shows.

    Args:
      env: made for that many environments.
    """
    ticks = max(round(seconds / env.control_period), 1)

    def tick(now: Any, _: Any) -> tuple[Any, Any]:
        state, carry = now
        carry, action = act(policy.params, carry, state.obs["actor"])
        after = jax.vmap(env.step)(state, action)
        readings = {name: getattr(state.readings, name) for name in READINGS}
        return (after, carry), (readings, after.joint_target, after.terminated, jax.vmap(protocol.snapshot)(state))

    protocol = evaluation_of(env)
    starts = jit(protocol.evaluation_starts, once=True)(protocol.evaluation_plan(episodes, seed))
    run = jit(lambda begin: jax.lax.scan(tick, begin, None, length=ticks), backend=env.backend)
    readings, target, ended, frames = jax.device_get(run((starts, policy.initial_carry(episodes)))[1])
    trajectories, snapshots = [], []
    for i in range(episodes):
        length = int(np.argmax(ended[:, i])) + 1 if ended[:, i].any() else ticks
        rows = {name: values[:length, i] for name, values in readings.items()}
        trajectories.append(Trajectory(time=np.arange(length) * env.control_period, target=target[:length, i], **rows))
        snapshots.append(frames.map(operator.itemgetter((slice(length), i))))
    return trajectories, snapshots


def draw_pictures(env: Any, snapshots: Snapshot) -> np.ndarray:
    """PNG files [T], as bytes, of what a camera would see: hand and object, but neither forces nor goal."""
    bare = dataclasses.replace(snapshots, taxel_force=np.zeros_like(snapshots.taxel_force), goal_rotation=None)
    camera, files = camera_of(env.name, env.hand), []
    for t, pose in enumerate(hand_poses(env.hand, snapshots.joint_position)):
        frame = bare.map(operator.itemgetter(t))
        file = io.BytesIO()
        Image.fromarray(draw_scene(env.hand, env.primitive_kinds, frame, pose, camera, _PICTURE, 1.0)).save(file, "PNG")
        files.append(file.getvalue())
    return np.array(files, object)


@dataclasses.dataclass(frozen=True, kw_only=True)
class RecordArguments(Config):
    """Record simulated episodes of a policy for other programs."""

    policy: Annotated[str, tyro.conf.Positional]
    """A policy file, or the name of a shipped policy, such as grasp."""
    lerobot: Path | None = None
    """Folder for a dataset in the LeRobot format (extra `lerobot`), which must not exist yet; None writes none."""
    pictures: bool = False
    """Draw what a camera would see into the LeRobot dataset."""
    rrd: Path | None = None
    """Recording of the first episode for the rerun viewer (extra `rerun`); None writes none."""
    npz: Path | None = None
    """File (.npz) of the episodes for `dexsim view`; None writes none."""
    episodes: int = setting(8, unit="1", low=1, high=1024)
    """Number of episodes."""
    seconds: float = setting(8.0, unit="s", low=0.1, high=600.0)
    """Longest duration of an episode."""
    seed: int = setting(0, unit="1", low=0, high=2**32 - 2)
    """Seed of the episodes."""
    task: str = ""
    """Module and name of a task of your own, such as my_module:poke; the policy's file names all others."""


def main(argv: Sequence[str] | None = None) -> int:
    """The command. Returns its exit code, 0."""
    arguments = cli.parse(RecordArguments, argv)
    if not (arguments.lerobot or arguments.rrd or arguments.npz):
        raise ConfigError("give --lerobot FOLDER, --rrd FILE or --npz FILE")
    policy = load_policy(arguments.policy, task=arguments.task)
    # First what could be wrong after minutes of simulation.
    cli.check_no_overwrite({"--rrd": arguments.rrd, "--npz": arguments.npz}, {"policy": arguments.policy})
    if arguments.lerobot:
        check_lerobot(arguments.lerobot)
    if arguments.rrd:
        require("rerun", "rerun", "a recording for the rerun viewer")
    for path in filter(None, (arguments.rrd, arguments.npz)):
        cli.check_writable(path)
    cli.enable_caches()
    env = policy.make_env()
    trajectories, snapshots = record(
        policy, env, episodes=arguments.episodes, seconds=arguments.seconds, seed=arguments.seed
    )
    if arguments.lerobot:
        if arguments.pictures:
            pairs = zip(trajectories, snapshots, strict=True)
            trajectories = [dataclasses.replace(one, picture=draw_pictures(env, frames)) for one, frames in pairs]
        write_lerobot(arguments.lerobot, env.hand, policy.task, trajectories)
        print(f"LeRobot dataset: {arguments.lerobot}, {len(trajectories)} episodes")
    if arguments.rrd:
        first = trajectories[0]
        series = {name: getattr(first, name) for name in (*READINGS, "target") if name != "taxel_force"}
        series["force"] = first.taxel_force.sum(-1)
        show_rerun(env.hand, first.time, series, first.taxel_force, arguments.rrd)
        print(f"rerun recording: {arguments.rrd}")
    if arguments.npz:
        kinds, period = env.primitive_kinds, env.control_period
        recorded = Episodes(task=policy.task, hand=env.hand, period=period, kinds=kinds, snapshots=snapshots)
        write_episodes(arguments.npz, recorded)
        print(f"episodes for dexsim view: {arguments.npz}")
    return 0


if __name__ == "__main__":
    cli.run(main)
