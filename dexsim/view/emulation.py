"""The emulated hand with a policy, in virtual time: true poses, and touch as the bridge measures it."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from dexsim.hand.load import load_hand
from dexsim.render.snapshot import Snapshot
from dexsim.view.scene import Frame
from dexsim_ppo.policy import load_policy
from dexsim_real.control.controller import Controller, prepare_jax
from dexsim_real.core.errors import HandError
from dexsim_real.twin.plant.emulated_hand import EmulatedHand
from dexsim_real.twin.plant.parameters import TASKS
from dexsim_real.twin.plant.shapes import matrix
from dexsim_real.twin.virtual import VirtualRun
from dexsim_real.wire.driver import check_wire


class Emulation:
    """Trials of a policy (a file, or a shipped one's name) on the emulated hand, one an episode. Raises HandError: the
    emulated hand has no such task or mount, or the policy observes what no sensor measures."""

    def __init__(self, name: str, seed: int = 0, hand: str = ""):
        prepare_jax()
        policy = load_policy(name)
        self.hand = policy.find_hand(hand) or load_hand()
        if policy.task not in TASKS:
            raise HandError(f"{name}: expected a policy of {' or '.join(TASKS)}, got {policy.task!r}")
        check_wire(self.hand)
        self._controller = Controller(policy, self.hand)
        self._controller.warm()
        self.period, self.task, self._seed, self._trial = self._controller.period, policy.task, seed, -1

    def add_controls(self, gui: Any) -> None:
        """The grip command, where the policy takes one."""
        self._command = None
        if not self._controller.spec.turn:
            self._command = gui.add_slider("command", min=0.0, max=1.0, step=0.05, initial_value=0.5)

    def episode(self) -> Iterator[Frame]:
        self._trial += 1
        plant = EmulatedHand(self.hand, self.task, self._seed, trials=1, first=self._trial)
        run = VirtualRun(plant, self._controller)
        ticks = run.ticking()
        while True:
            run.policy.command = self._command.value if self._command else 0.5
            if next(ticks, None) is None:
                return
            yield self._frame(run)

    def _frame(self, run: VirtualRun) -> Frame:
        plant, policy, sample = run.plant, run.policy, run.safety.sample
        assert sample is not None, "the policy has ticked"
        joints, position, quat = plant.true_pose()
        parts, goals, measured = plant.shape.parts, policy.goals, sample.measured
        target = np.interp(policy.command, (0, 1), self._controller.spec.finger_force or (np.nan, np.nan))
        snapshot = Snapshot(
            joint_position=joints,
            object_position=position,
            object_rotation=matrix(quat),
            primitive_size=np.array([(*part.size, 0, 0)[:3] for part in parts]),
            primitive_position=np.array([part.place for part in parts]),
            primitive_rotation=np.array([matrix(part.quat) for part in parts]),
            primitive_active=np.ones(len(parts), bool),
            taxel_force=measured.taxel_force,
            command=np.array(policy.command),
            target_force=np.float32(target),
            finger_force=measured.finger_force,
            goal_rotation=matrix(goals.quat) if goals else None,
            turns=goals.successes if goals else None,
            seconds=run.port.time,
        )
        kinds, command = tuple(part.kind for part in parts), policy.command if self._command else None
        return Frame(snapshot, kinds, f"trial {self._trial}", command)
