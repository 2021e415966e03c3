"""Settings of the grasp task; what its policy observes is `dexsim.observation.GRASP`."""

import dataclasses

from dexsim.control import Control, ForceLoop
from dexsim.core.config import Config, Range, setting
from dexsim.env.config import EnvConfig
from dexsim.touch.skin import Skin


@dataclasses.dataclass(frozen=True, kw_only=True)
class GraspReward(Config):
    """Weights and widths of the reward terms, per control tick."""

    force: float = setting(2.0, unit="1", low=0.0, high=1000.0)
    """Weight of R_force: force of each touching finger against its target."""
    torque: float = setting(0.2, unit="1", low=0.0, high=1000.0)
    """Weight of R_torque: root-joint torque of each touching finger against its target."""
    alive: float = setting(0.5, unit="1", low=0.0, high=1000.0)
    """Reward for each tick in which the object is held."""
    spread: float = setting(-0.5, unit="1/rad^2", low=-1000.0, high=0.0)
    """Weight of R_diff: variance of the first joint angles of the four inner fingers."""
    outer: float = setting(-0.05, unit="1/rad", low=-1000.0, high=0.0)
    """Weight of R_outer: distance of the four fingers' joints from their centre posture."""
    action: float = setting(-0.02, unit="1", low=-1000.0, high=0.0)
    """Weight of R_action: squared change of the action."""
    velocity: float = setting(-0.002, unit="s^2/rad^2", low=-1000.0, high=0.0)
    """Weight of R_vel: squared joint velocity."""
    drop: float = setting(-20.0, unit="1", low=-10000.0, high=0.0)
    """Reward when the object is lost, paid once."""
    sigma: float = setting(0.10, unit="1", low=0.001, high=10.0)
    """Width of the narrow Gaussian, in units of the maximum force or torque (the paper's value)."""
    tail: float = setting(0.4, unit="1", low=0.0, high=1.0)
    """Share in the reward of a wide Gaussian, which gives a gradient far from the target."""
    overload: float = setting(-0.5, unit="1", low=-1000.0, high=0.0)
    """Weight of the four fingers' force more than 1 N above their target, divided by `max_force`. The Gaussians are
    flat there: a finger that carries an object nearly alone gains nothing by relaxing a little."""
    thumb: str = setting("loose", choices=("loose", "binary"))
    """Force term of the thumb, which opposes all other fingers and needs more force than each of them. loose: the wide
    Gaussian only; binary: the paper's, any force within the bounds."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class GraspConfig(EnvConfig):
    """The grasp task."""

    control: Control = setting(Control(reach=0.33, force=ForceLoop(gain=0.5, limit=1.5)))
    """From action to joint target. The reach keeps the thumb's joints below their torque limit, where force could not
    follow a command. The force loop is for use: training goes without."""
    episode_seconds: float = setting(3.0, unit="s", low=0.2, high=3600.0)
    """Training episode length. Short episodes practise the catch, in which most of the lost objects are lost."""
    evaluation_seconds: float = setting(8.0, unit="s", low=0.2, high=3600.0)
    """Evaluation episode length; the object must be held this long. Force is scored from 3 s on."""
    finger_force: Range | None = setting(None, unit="N", low=0.05, high=40.0)
    """Target of each touching finger but the thumb, at command 0 and 1; None for those that the hand's TOML gives."""
    max_force: float = setting(6.9, unit="N", low=0.5, high=200.0)
    """Force that forces are normalised by."""
    push_probability: float = setting(0.015, unit="1", low=0.0, high=1.0)
    """Probability per tick of a push on the object."""
    push_speed: float = setting(0.3, unit="m/s", low=0.0, high=5.0)
    """Largest change of the object's speed in a push."""
    drop_distance: float = setting(0.12, unit="m", low=0.02, high=1.0)
    """The object is lost when its centre is farther than this from the grasp centre."""
    posture: tuple[float, ...] = setting((), unit="rad", low=-3.2, high=3.2)
    """Joint angles that episodes start near; empty for those that the hand's TOML gives."""
    curl: Range = setting((-0.3, 0.1), unit="rad", low=-3.0, high=3.0)
    """Range added to all joints of the four fingers alike: how far closed they start."""
    release_gap: Range = setting((0.001, 0.009), unit="m", low=0.0, high=0.1)
    """Range of the gap between palm and object at release."""
    release_delay: Range = setting((0.1, 0.5), unit="s", low=0.0, high=2.0)
    """Range of the time for which somebody still holds the object after the fingers have begun to move."""
    reward: GraspReward = setting(GraspReward())
    """Reward weights."""


def paper() -> GraspConfig:
    """The paper's rewards: the narrow Gaussian alone, the thumb's binary terms, nothing for holding and no penalty of
    force. The paper gives no weight and no target in N: docs/equations.md."""
    return GraspConfig(
        control=Control(),
        finger_force=(2.0, 7.0),
        max_force=10.0,
        reward=GraspReward(force=2.0, torque=2.0, alive=0.0, overload=0.0, tail=0.0, thumb="binary"),
        skin=Skin(total="solver"),
    )
