"""A simulated hand with a policy, one tick a frame, and the policies to choose from."""

import contextlib
import dataclasses
import functools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dexsim.core.assets import asset_path
from dexsim.core.compilation import jit
from dexsim.env.env import Env
from dexsim.env.evaluation import take_snapshot
from dexsim.env.state import State
from dexsim.errors import CheckpointError
from dexsim.objects.config import KINDS
from dexsim.view.scene import Frame
from dexsim.view.viewer import clicked
from dexsim_ppo.policy import Policy, load_policy

NONE = "none"
"""The choice of no policy: actions are zero."""
_ANY = "any"
_SHOWN = 1.0  # s that a dropped object stays in sight
_NEWEST = 20  # files of runs that are listed


def find_policies(env: Env, first: str, runs: Path = Path("runs")) -> dict[str, Policy | None]:
    """Policies that take an environment's observation, by the name of a shipped one or the path of a file: `first`,
    shipped ones, the newest files of `runs`, and `NONE`."""
    shipped = sorted(path.stem for path in asset_path("policies").glob("*.msgpack"))
    files = [path for name in ("best", "last") for path in runs.glob(f"*/{name}.msgpack")]
    newest = sorted(files, key=lambda path: -path.stat().st_mtime)[:_NEWEST]
    fitting: dict[str, Policy | None] = {}
    for name in dict.fromkeys([first, *shipped, *map(str, newest), NONE]):
        with contextlib.suppress(CheckpointError):  # damaged, or being replaced
            policy = None if name == NONE else load_policy(name)
            if policy is None or policy.observation_layout == tuple(env.observation_layout["actor"]):
                fitting[name] = policy
    return fitting


class Simulation:
    """Episodes of an environment; the page chooses policy, object, command, friction and pushes."""

    def __init__(self, env: Env, policies: dict[str, Policy | None], seed: int = 0):
        self.env, self.hand, self.period, self.policies = env, env.hand, env.control_period, policies
        self.task = env.name
        self._random = np.random.default_rng(seed)
        self._key = jax.random.key(seed)
        self._shapes = np.asarray(env.pool.object.shape_index)
        # The goal of an evaluation: it does not change or give up by itself.
        _, goals = env.task.evaluation_plan(1, self._shapes)
        self._goal = jax.tree.map(lambda x: jnp.asarray(x)[0], goals)
        self._reset = jit(env.reset_from, once=True)
        self._step = jit(self._tick, backend=env.backend)
        self._snapshot = jit(functools.partial(take_snapshot, env), backend=env.backend)
        self._state: State

    def add_controls(self, gui: Any) -> None:
        """Policy, object (where the task has several), command (where it has one), friction and pushes."""
        self._policy = gui.add_dropdown("policy", tuple(self.policies))
        kinds = [KINDS[index] for index in np.unique(self._shapes)]
        self._kind = gui.add_dropdown("object", (_ANY, *kinds)) if len(kinds) > 1 else None
        self._command = None
        if hasattr(self._goal, "command"):
            self._command = gui.add_slider("command", min=0.0, max=1.0, step=0.05, initial_value=0.5)
        self._friction = gui.add_slider("friction factor", min=0.1, max=2.0, step=0.05, initial_value=1.0)
        self._speed = gui.add_slider("push [m/s]", min=0.0, max=2.0, step=0.1, initial_value=0.5)
        self._push = gui.add_button("push")

    def episode(self) -> Iterator[Frame]:
        kind = self._kind.value if self._kind else _ANY
        rows = np.arange(len(self._shapes)) if kind == _ANY else np.flatnonzero(self._shapes == KINDS.index(kind))
        self._key, key = jax.random.split(self._key)
        row = self._random.choice(rows)
        self._state = self._reset(key, jax.tree.map(lambda rows: rows[row], self.env.pool), self._goal)
        object, ended = self._state.episode.object, 0.0
        bare = object.friction, object.link_friction  # as drawn: the page scales them
        acting: Policy | None = None
        carry: Any = None  # of the policy that is acting
        yield self._frame()
        while ended < _SHOWN:
            policy, action = self.policies[self._policy.value], jnp.zeros(self.env.action_size)
            if policy is not acting:
                acting, carry = policy, policy and policy.initial_carry()
            if policy is not None:
                carry, action = policy.act(carry, self._state.obs["actor"])
            push = np.zeros(3, np.float32)
            if clicked(self._push):
                push = self._random.normal(size=3).astype(np.float32)
                push *= np.float32(self._speed.value / np.linalg.norm(push))
            command = np.float32(self._command.value if self._command else 0.0)
            self._state = self._step(self._state, action, command, np.float32(self._friction.value), push, bare)
            dropped = bool(self._state.terminated) or ended > 0
            ended = ended + self.period if dropped else 0.0
            yield self._frame("dropped" if dropped else "")

    def _tick(
        self, state: State, action: jax.Array, command: jax.Array, friction: jax.Array, push: jax.Array, bare: Any
    ) -> State:
        """A step after which the page's changes hold: what they do is seen in the next observation."""
        tips, links = bare
        object = dataclasses.replace(state.episode.object, friction=tips * friction, link_friction=links * friction)
        dofs = self.env.physics.object_dof[:3]
        physics = dataclasses.replace(state.physics, qvel=state.physics.qvel.at[dofs].add(push))
        goal = state.goal
        if hasattr(goal, "command"):
            goal = dataclasses.replace(goal, command=command)
        episode = dataclasses.replace(state.episode, object=object)
        return self.env.step(dataclasses.replace(state, episode=episode, physics=physics, goal=goal), action)

    def _frame(self, note: str = "") -> Frame:
        command = self._command.value if self._command else None
        return Frame(jax.device_get(self._snapshot(self._state)), self.env.primitive_kinds, note, command)
