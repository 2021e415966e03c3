"""The referee: metrics of a trial on the emulated hand, from the true state.

No sensor, calibration or goal of the runner is used. The rules are those of the tasks. A grasped object is lost beyond
0.12 m from its nominal position. A cube has reached a goal within 0.3 rad and 0.05 m (the paper's count) and at no more
than 2 rad/s (the task's count); it is lost beyond 0.07 m, when tipped by 1 rad, or, held clear of the palm, when it
touches the palm.

A loss has one of these causes, the first that holds:

- untouched: no two fingertips ever touched the object at once
- disturbed: a push acted on it within the last half second
- trapped: a cube stood tilted on one fingertip or none for most of the last two seconds
- at the torque limit: a joint was, for most of the last half second with a touch
- tipped: a cube's axis left the axis of rotation
- on the palm: a cube that is held clear of it came down on it
- pushed out, slipped: a fingertip touched in the last 0.2 s, or none did
"""

import collections
import math
from typing import Any, NamedTuple

import numpy as np

from dexsim_real.twin.plant.parameters import Start, skill_of
from dexsim_real.twin.plant.shapes import matrix, product, turn

LIMITS = {"grasp": 8.0, "rotate": 120.0}  # s, time limit of a trial
LOST = {"grasp": 0.12, "rotate": 0.07}  # m, drop radius
GOAL_ANGLE, GOAL_DISTANCE, GOAL_SPIN = 0.3, 0.05, 2.0  # rad, m, rad/s
_FASTEST = {"task": GOAL_SPIN, "paper": math.inf}  # rad/s about the axis at which a goal counts
TIPPED = 1.0  # rad
TOUCH = 0.1  # N above which a fingertip counts as touching (for forces of a grasp: `_GRIP`)
_GRIP = 0.01  # N
_SETTLE = 3.0  # s after release before forces count
_RECENT = 0.2  # s; a fingertip that touched this shortly before a drop pushed the object out
_LEAD, _TRAP = 0.5, 2.0  # s before a drop in which its cause shows; in which a trap does
_TRAPPED = 0.35  # rad, tilt of a cube in a trap
ON_PALM = 0.001  # m, height above the palm at which a cube touches it


class Look(NamedTuple):
    """The true state at one time, palm frame; J joints, F fingers."""

    position: np.ndarray  # [3] m of the object
    quat: np.ndarray  # [4]
    velocity: np.ndarray  # [3] rad/s of the object
    height: float  # m of its lowest point above the palm
    force: np.ndarray  # [F] N on the fingertips
    normal: np.ndarray  # [F] N, its part along the contact's normal
    taxels: np.ndarray  # [F] N on the taxels
    joint_position: np.ndarray  # [J] rad
    joint_speed: np.ndarray  # [J] rad/s
    limited: bool  # a joint is at its torque limit
    disturbed: bool  # a push acts on the object

    @property
    def touching(self) -> int:
        """Number of fingertips that touch the object."""
        return int(np.sum(self.force > TOUCH))

    def tilt(self, axis: np.ndarray) -> float:
        """Angle rad between an axis [3] and where the object has carried it."""
        return math.acos(float(np.clip(matrix(self.quat) @ axis @ axis, -1.0, 1.0)))


class Referee:
    """Follows one trial from release to end.

    `seconds` is the time limit, None that of the task.
    """

    def __init__(self, task: str, start: Start, seconds: float | None = None, fingers: int = 5):
        self.task = task = skill_of(task)
        self._start, self._axis, self.limit = start, start.axis, LIMITS[task] if seconds is None else seconds
        self.time, self.end = 0.0, ""  # s; why the trial ended, empty while it lasts
        self.window = min(_SETTLE, self.limit / 2), self.limit  # s after release between which forces count
        self._touched = -math.inf
        self._counted, self._limited = 0, 0
        self._force, self._speed = np.zeros(fingers), 0.0
        self._finger = dict.fromkeys(("force", "normal", "taxels"), 0.0)
        self.goals = dict.fromkeys(_FASTEST, 0)  # consecutive ones, by whose count
        self._heading: float | None = None  # rad, at the release
        self._looks: collections.deque[tuple[float, Look]] = collections.deque()  # and their times s
        self._gripped = False  # whether two fingertips ever touched at once

    def watch(self, step: float, look: Look) -> None:
        """Update with the current state, `step` s after the last update."""
        if self.end:
            return
        self.time += step
        self._speed += step * float(np.mean(np.abs(look.joint_speed)))
        if look.touching:
            self._touched = self.time
        away = float(np.linalg.norm(look.position - self._start.reference))
        self._gripped |= look.touching >= 2
        self._looks.append((self.time, look))
        while self._looks[0][0] < self.time - _TRAP:
            self._looks.popleft()
        fallen = self.task == "rotate" and look.tilt(self._axis) > TIPPED or self._start.clear and look.height < ON_PALM
        if away > LOST[self.task] or fallen:
            self.end = f"dropped: {self._cause(away)}"
            return
        if self.task == "rotate":
            self._count_goals(look, away)
        elif self.time > self.window[0]:
            # The command applies to the four fingers; the thumb balances them.
            holding = look.force[1:] > _GRIP
            if holding.any():
                for name in self._finger:
                    self._finger[name] += float(getattr(look, name)[1:][holding].mean())
            self._force += look.force
            self._counted += 1
            self._limited += look.limited
        if self.time >= self.limit - 1e-9:
            self.end = "time limit"

    def _cause(self, away: float) -> str:
        """Why the object is lost, which now is `away` m from its place; see the head of this module."""
        last = [look for time, look in self._looks if time >= self.time - _LEAD]
        touched = [look.limited for look in last if look.touching]
        trapped = [look.tilt(self._axis) > _TRAPPED and look.touching <= 1 for _, look in self._looks]
        if not self._gripped:
            return "untouched"
        if any(look.disturbed for look in last):
            return "disturbed"
        if self.task == "rotate" and self.time > _TRAP and np.mean(trapped) > 0.7:
            return "trapped"
        if touched and np.mean(touched) > 0.5:
            return "at the torque limit"
        if away <= LOST[self.task]:
            return "on the palm" if self._start.clear and last[-1].height < ON_PALM else "tipped"
        return "pushed out" if self.time - self._touched <= _RECENT else "slipped"

    def _count_goals(self, look: Look, away: float) -> None:
        """Goals are 90 degrees apart about the axis, from the first heading on."""
        if self._heading is None:  # Angle of the rotation about it nearest to the orientation.
            self._heading = 2 * math.atan2(look.quat[1:] @ self._axis, look.quat[0])
        spin = abs(float(look.velocity @ self._axis))
        for name, fastest in _FASTEST.items():
            goal = turn(self._axis, self._heading + (self.goals[name] + 1) * self._start.turn)
            angle = 2 * math.acos(min(1.0, abs(float(product(goal * [1, -1, -1, -1], look.quat)[0]))))
            self.goals[name] += angle < GOAL_ANGLE and away < GOAL_DISTANCE and spin <= fastest

    def report(self) -> dict[str, Any]:
        """Metrics so far; JSON-able.

        The forces of a grasp are those of `dexsim.tasks.grasp.report`, by the same names and over the same window:
        "finger_force" is the whole contact force of a touching finger, "finger_normal" what of it presses into the
        skin, "finger_taxels" what of that the taxels bear; "torque_limited" is the share of the window with a joint at
        its torque limit.
        """
        lived, count = max(self.time, 1e-9), max(self._counted, 1)
        speed = round(self._speed / lived, 4)
        report: dict[str, Any] = {"seconds": round(self.time, 4), "end": self.end or "running", "joint_speed": speed}
        if self.end.startswith("dropped") and self._looks:
            before = next(look for time, look in self._looks if time >= self.time - _LEAD)
            names = ("joint_position", "object_position", "object_quat", "finger_force")
            poses = (before.joint_position, before.position, before.quat, before.force)
            report["before"] = {name: np.round(pose, 4).tolist() for name, pose in zip(names, poses, strict=True)}
        if self.task == "grasp":
            return report | {
                "held": self.end == "time limit",
                "force": np.round(self._force / count, 4).tolist(),
                "window_s": list(self.window),
                **{f"finger_{name}": round(total / count, 4) for name, total in self._finger.items()},
                "total_force": round(float(self._force.sum()) / count, 4),
                "torque_limited": round(self._limited / count, 4),
            }
        return report | {
            "successes": self.goals["task"],
            "paper_successes": self.goals["paper"],
            "seconds_to_fall": round(self.time, 4),
            "fell": self.end.startswith("dropped"),
        }
