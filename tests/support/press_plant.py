"""The emulated hand on a press bench: an emulated person holds a pen in front of the fingertip that is to press.

For `dexsim_real.calibrate`, with the drives, gears and taxels of the trials; `truth` is what it should find. The pen
is across the finger on a block of foam, which yields along its normal and, more softly, across it.
"""

import copy

import mujoco
import numpy as np

from dexsim.hand.mjcf import quaternion
from dexsim_real.calibrate.procedure import Placement, placements
from dexsim_real.twin.plant.emulated_hand import EmulatedHand, Stage, put
from dexsim_real.twin.plant.shapes import ObjectShape, Primitive, matrix
from dexsim_real.wire.frames import Mode

_RADIUS = 0.006  # m
PEN = ObjectShape("capsule", (Primitive("capsule", (_RADIUS, 0.020)),))
_AWAY = np.array([0.4, 0.0, 0.0])
_TOLERANCE = 0.015  # rad, largest distance of targets from the path of a placement
_STIFFNESS, _SHEAR = 1000.0, 400.0  # N/m of the foam along its normal and across it
_GAP = 0.002  # m between fingertip and pen at the posture of contact
_TURN = 0.5  # Nm/rad, rotational stiffness of the foam
_RATIO = 0.7  # damping ratio of both springs
_SOLID = {"mass": 0.1, "inertia_scale": 10.0, "com_offset": 0.0}


class PressBench(EmulatedHand):
    """A hand with a pen on foam as its object, and one trial without end."""

    def __init__(self, hand, seed=0, kind="outside"):
        super().__init__(hand, "grasp", seed, kind=kind, overrides=_SOLID)
        self._plan, self.stage = placements(hand), Stage.FREE
        skin, noise = copy.copy(self._skin), self._noise
        self._enter(self._draw(self.parameters, PEN), np.random.default_rng(seed))
        self._skin, self._noise = skin, noise  # It is still the hand of the first trial.
        self._probe = mujoco.MjData(self._scene.model)
        self._pressing_placement: Placement | None = None
        self._remove()
        mujoco.mj_forward(self._scene.model, self._data)
        self._remember()

    def gauge(self) -> float:
        """Force N of the pen on the foam along its normal, as a perfect scale under it shows."""
        return max(float(-self._spring @ self._facing), 0.0)

    def truth(self) -> dict[str, list[float]]:
        """Values that a calibration should find: Nm per reported A (loading, unloading), taxel gains by finger."""
        parameters, drives = self.parameters, self._drives
        constant = drives.constant / parameters.current_gain
        loss = 1.0 - drives.efficiency
        return {
            "loading_nm_per_a": (constant * (1 - loss)).tolist(),
            "unloading_nm_per_a": (constant * (1 + loss)).tolist(),
            "taxel_gain": parameters.taxel_gain.tolist(),
        }

    def _before(self) -> None:
        """Apply the springs that hold the pen."""
        scene, data = self._scene, self._data
        at, dof, mass = scene.object_qpos, scene.object_dof, self.parameters.mass
        shift, speed = data.qpos[at : at + 3] - self._place[0], data.qvel[dof : dof + 3]
        along = np.outer(self._facing, self._facing)
        across = np.eye(3) - along
        force = -(_STIFFNESS * along + _SHEAR * across) @ shift
        force -= 2 * _RATIO * (np.sqrt(_STIFFNESS * mass) * along + np.sqrt(_SHEAR * mass) * across) @ speed
        skew = np.empty(3)
        mujoco.mju_subQuat(skew, data.qpos[at + 3 : at + 7], self._place[1])
        inertia = float(scene.model.body_inertia[scene.object_body].max())
        torque = -_TURN * skew - 2 * _RATIO * np.sqrt(_TURN * inertia) * data.qvel[dof + 3 : dof + 6]
        wrench = data.xfrc_applied[scene.object_body]
        wrench[:3], wrench[3:] = force - mass * self._gravity, matrix(data.qpos[at + 3 : at + 7]) @ torque
        self._spring = force

    def _look(self) -> None:
        """Hold the pen in front of the fingertip that is about to press."""
        command = self._command
        if self._touches:
            return
        if command is None or not np.all(command["mode"] == Mode.POSITION):
            self._remove()
            return
        placement = next((p for p in self._plan if self._waits(p, command["position"])), self._pressing_placement)
        if placement is not None and placement is not self._pressing_placement:
            self._hold_before(placement)
        elif self._pressing_placement is not None and self._left(command["position"]):
            self._remove()

    def _waits(self, placement: Placement, target: np.ndarray) -> bool:
        """Whether these targets [12] rad are on the path to the contact of a placement."""
        advance = (target - placement.posture) @ placement.direction / (placement.direction @ placement.direction)
        off = np.abs(target - placement.posture - advance * placement.direction).max()
        return bool(off < _TOLERANCE and -0.7 < advance < -0.03)

    def _left(self, target: np.ndarray) -> bool:
        placement = self._pressing_placement
        assert placement is not None, "the pen is away"
        others = np.setdiff1d(np.arange(len(target)), placement.joints)
        return bool(np.abs(target - placement.posture)[others].max() > 3 * _TOLERANCE)

    def _hold_before(self, placement: Placement) -> None:
        """Place the pen across the finger at the taxels of a placement, with the gap."""
        self._pressing_placement, probe, model = placement, self._probe, self._scene.model
        probe.qpos[self._scene.drive_qpos] = placement.posture
        mujoco.mj_kinematics(model, probe)
        site, finger = self._scene.tip_site[placement.finger], placement.finger
        frame = probe.site_xmat[site].reshape(3, 3)
        taxels = list(placement.taxels)
        point = probe.site_xpos[site] + frame @ self.hand.taxel_position[finger, taxels].mean(0)
        normal = frame @ self.hand.taxel_normal[finger, taxels].mean(0)
        self._facing = normal / np.linalg.norm(normal)
        last = self.hand.taxel_grid[1] - 1
        along = frame @ (self.hand.taxel_position[finger, last] - self.hand.taxel_position[finger, 0])
        quat = _facing(self._facing, along)
        far = 0.03
        put(self._scene, probe, point + (_RADIUS + far) * self._facing, quat)
        mujoco.mj_kinematics(model, probe)
        pen = model.geom("object_0").id
        touching = np.union1d(model.pair_geom1, model.pair_geom2)
        tips = touching[self._scene.finger_of_geom[touching] == finger]
        gap = min(mujoco.mj_geomDistance(model, probe, int(tip), pen, 0.1, None) for tip in tips)
        self._put(point + (_RADIUS + far - gap + _GAP) * self._facing, quat)

    def _remove(self) -> None:
        self._pressing_placement, self._facing = None, np.array([0.0, 0.0, 1.0])
        self._put(_AWAY, np.array([1.0, 0.0, 0.0, 0.0]))

    def _put(self, position: np.ndarray, quat: np.ndarray) -> None:
        self._place, self._spring = (position, quat), np.zeros(3)
        put(self._scene, self._data, position, quat)


def _facing(normal: np.ndarray, along: np.ndarray) -> np.ndarray:
    """Orientation [4] with x along the normal and z across the finger."""
    y = along - along @ normal * normal
    y /= np.linalg.norm(y)
    return quaternion(np.stack([normal, y, np.cross(normal, y)], 1))
