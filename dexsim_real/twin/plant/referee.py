"""The referee: metrics of a trial on the emulated hand, from the true state.

No sensor, calibration or goal of the runner is used. The rules are those of the tasks. A grasped object is lost beyond
0.12 m from its nominal position. A cube has reached a goal within 0.3 rad and 0.05 m (the paper's count) and at no more
than 2 rad/s (the task's count); it is lost beyond 0.07 m, or when tipped by 1 rad.
"""

import math
from typing import Any

import numpy as np

from dexsim_real.twin.plant.assistant import REFERENCES
from dexsim_real.twin.plant.shapes import matrix, product, turn

LIMITS = {"grasp": 8.0, "rotate": 120.0}
"""Time limit in s of a trial, by task."""
LOST = {"grasp": 0.12, "rotate": 0.07}  # m, drop radius
GOAL_STEP, GOAL_ANGLE, GOAL_DISTANCE, GOAL_SPIN = math.pi / 2, 0.3, 0.05, 2.0  # rad, rad, m, rad/s
TIPPED = 1.0  # rad
TOUCH = 0.1  # N above which a fingertip counts as touching (for forces of a grasp: `_GRIP`)
_GRIP = 0.01  # N
_SETTLE = 3.0  # s after release before forces count
_RECENT = 0.2  # s; a fingertip that touched this shortly before a drop pushed the object out
_AXIS = np.array([1.0, 0.0, 0.0])


class Referee:
    """Follows one trial from release to end.

    Args:
      task: "grasp" or "rotate".
      seconds: time limit; None is that of the task.
    """

    def __init__(self, task: str, seconds: float | None = None):
        self.task, self.limit = task, LIMITS[task] if seconds is None else seconds
        self.time, self.end = 0.0, ""
        self._reference = np.array(REFERENCES[task])
        self._touched = -math.inf
        self._counted, self._weight = 0, 0.0
        self._force, self._total, self._limited = np.zeros(5), 0.0, 0.0
        self._finger = dict.fromkeys(("force", "normal", "taxels"), 0.0)
        self._duty, self._speed = np.zeros(5), 0.0
        self.goals = None if task == "grasp" else {"task": GoalCount(GOAL_SPIN), "paper": GoalCount(math.inf)}

    @property
    def over(self) -> bool:
        """Whether the trial has ended."""
        return bool(self.end)

    def watch(
        self,
        step: float,
        position: np.ndarray,
        quat: np.ndarray,
        spin: np.ndarray,
        tips: np.ndarray,
        normal: np.ndarray,
        taxels: np.ndarray,
        joint_speed: np.ndarray,
        at_limit: np.ndarray,
    ) -> None:
        """Update with the current state.

        Args:
          step: s since the last update.
          position: [3] m of the object, palm frame.
          quat: [4] orientation of the object, palm frame.
          spin: [3] rad/s, angular velocity of the object, palm frame.
          tips: [5, 3] N, the solver's force on each fingertip.
          normal: [5] N of that, along the contact's normal.
          taxels: [5] N of that, on the taxels.
          joint_speed: [12] rad/s.
          at_limit: [12] bool, joints at their torque limit.
        """
        if self.over:
            return
        self.time += step
        strength = np.linalg.norm(tips, axis=-1)
        self._speed += step * float(np.mean(np.abs(joint_speed)))
        self._duty += step * (strength > TOUCH)
        if np.any(strength > TOUCH):
            self._touched = self.time
        away = float(np.linalg.norm(position - self._reference))
        tilt = math.acos(float(np.clip(matrix(quat)[:, 0] @ _AXIS, -1.0, 1.0)))
        if away > LOST[self.task] or (self.goals and tilt > TIPPED):
            pushed = self.time - self._touched <= _RECENT
            kind = "tipped" if away <= LOST[self.task] else "pushed out" if pushed else "slipped"
            self.end = f"dropped: {kind}"
            return
        if self.goals:
            for count in self.goals.values():
                count.watch(self.time, quat, away, float(spin @ _AXIS))
        elif self.time > self.window[0]:
            self._grip({"force": strength, "normal": normal, "taxels": taxels})
            self._limited += bool(np.any(at_limit))
        if self.time >= self.limit - 1e-9:
            self.end = "time limit"

    @property
    def window(self) -> tuple[float, float]:
        """From when to when [s] after release forces count."""
        return min(_SETTLE, self.limit / 2), self.limit

    def _grip(self, forces: dict[str, np.ndarray]) -> None:
        """Accumulate forces [5]. The command applies to the four fingers; the thumb balances them."""
        strength = forces["force"]
        touching = strength[1:] > _GRIP
        if touching.any():
            for name, force in forces.items():
                self._finger[name] += float(force[1:][touching].mean())
        self._force += strength
        self._total += float(strength.sum())
        self._counted += 1

    def report(self) -> dict[str, Any]:
        """Metrics so far; JSON-able.

        The forces of a grasp are those of `dexsim.tasks.grasp.report`, by the same names and over the same window:
        "finger_force" is the whole contact force of a touching finger, "finger_normal" what of it presses into the
        skin, "finger_taxels" what of that the taxels bear; "torque_limited" is the share of the window with a joint at
        its torque limit.
        """
        lived, count = max(self.time, 1e-9), max(self._counted, 1)
        report: dict[str, Any] = {
            "seconds": round(self.time, 4),
            "end": self.end or "running",
            "duty": np.round(self._duty / lived, 4).tolist(),
            "joint_speed": round(self._speed / lived, 4),
        }
        if self.goals is None:
            return report | {
                "held": self.end == "time limit",
                "force": np.round(self._force / count, 4).tolist(),
                "window_s": list(self.window),
                **{f"finger_{name}": round(total / count, 4) for name, total in self._finger.items()},
                "total_force": round(self._total / count, 4),
                "torque_limited": round(self._limited / count, 4),
            }
        task, paper = self.goals["task"], self.goals["paper"]
        return report | {
            "successes": task.count,
            "paper_successes": paper.count,
            "success_times": task.times,
            "seconds_per_success": task.times[-1] / task.count if task.count else None,
            "seconds_to_fall": round(self.time, 4),
            "fell": self.over and self.end != "time limit",
            "turned": round(task.angle, 4),
        }


class GoalCount:
    """Counts consecutive goals 90 degrees apart about the palm's normal, from the first heading.

    Args:
      fastest: largest rad/s about the axis at which a goal counts.
    """

    def __init__(self, fastest: float):
        self._fastest = fastest
        self.count, self.angle = 0, 0.0
        self.times: list[float] = []
        self._start: float | None = None
        self._heading = 0.0

    def watch(self, time: float, quat: np.ndarray, away: float, spin: float) -> None:
        """Update with time s, orientation [4], distance m from the nominal position, spin rad/s about the axis."""
        heading = 2 * math.atan2(quat[1], quat[0])  # angle of the rotation about x nearest to the orientation
        if self._start is None:
            self._start = self._heading = heading
        self.angle += (heading - self._heading + math.pi) % (2 * math.pi) - math.pi
        self._heading = heading
        goal = turn((1.0, 0.0, 0.0), self._start + (self.count + 1) * GOAL_STEP)
        apart = 2 * math.acos(min(1.0, abs(float(product(goal * [1, -1, -1, -1], quat)[0]))))
        if apart < GOAL_ANGLE and away < GOAL_DISTANCE and abs(spin) <= self._fastest:
            self.count += 1
            self.times.append(round(time, 4))
