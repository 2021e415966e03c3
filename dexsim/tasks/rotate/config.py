"""Settings of the rotation task, and its variants by name."""

import dataclasses
import math

from dexsim.control import Control
from dexsim.core.config import Config, Range, setting
from dexsim.env.config import EnvConfig
from dexsim.errors import ConfigError
from dexsim.hand.description import Hand
from dexsim.hand.mirror import mirror_point
from dexsim.objects.config import ObjectConfig
from dexsim.observation import ObservationConfig
from dexsim.randomization import Randomization
from dexsim.task_spec import TurnSpec
from dexsim.touch.skin import Skin


@dataclasses.dataclass(frozen=True, kw_only=True)
class RotateReward(Config):
    """Weights of the reward terms, per control tick."""

    goal: float = setting(0.2, unit="rad", low=0.0, high=1000.0)
    """Weight of 1 / (d_rot + 0.1), the closeness to the goal, gated by the distance from the reference. The
    paper's weight, 1, rewards holding still at the end of a stroke."""
    gate: float = setting(0.05, unit="m", low=0.001, high=1.0)
    """Distance from the reference at which the gate is half closed."""
    bonus: float = setting(250.0, unit="1", low=0.0, high=1e5)
    """Reward for each goal reached, before `bonus_tips` and `bonus_speed` reduce it."""
    bonus_tips: float = setting(0.8, unit="1", low=0.0, high=1.0)
    """Share of the bonus that depends on three fingertips taking part, from the third goal of an episode on; a hand
    cannot earn it by standing still."""
    bonus_speed: float = setting(0.9, unit="rad/s", low=0.01, high=1e6)
    """Recent joint speed (mean of all joints) beyond which the bonus falls with the square of the speed."""
    action: float = setting(-0.01, unit="1", low=-1000.0, high=0.0)
    """Weight of the squared change of the action."""
    velocity: float = setting(-0.018, unit="s^2/rad^2", low=-1000.0, high=0.0)
    """Weight of the squared joint velocity."""
    torque: float = setting(-0.5, unit="1/Nm^2", low=-1000.0, high=0.0)
    """Weight of the squared joint torque: it discourages clamping the object at the end of a stroke."""
    spin: float = setting(2.0, unit="s/rad", low=0.0, high=1000.0)
    """Weight of the spin about the axis toward the goal, up to +-1 rad/s. It gives a gradient before the first
    goal is ever reached."""
    drop: float = setting(-50.0, unit="1", low=-10000.0, high=0.0)
    """Reward when the object is lost, paid once."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class RotateConfig(EnvConfig):
    """The rotation task, as a right hand does it; a left hand does the mirror image."""

    objects: ObjectConfig = setting(ObjectConfig(shapes=("box",), mass=(0.06, 0.15), link_friction=(0.3, 0.9)))
    """Mass, inertia, centre of mass, friction and contact of the object; its sizes are `edge`. Links have less friction
    than fingertips: with more, random strokes carry the object over the thumb."""
    control: Control = setting(Control(step=0.3, last_action_encoding="target"))
    """From action to joint target. With steps of 0.08 rad a cube is turned two thirds as fast."""
    edge: Range = setting((0.050, 0.060), unit="m", low=0.02, high=0.12)
    """Range of the edge of the cube that is turned, where `objects` has no mesh."""
    proportions: Range = setting((1.0, 1.0), unit="1", low=0.2, high=5.0)
    """Range of the factors on that edge along each axis of the object: a box in place of a cube. `objects.shapes` may
    name cylinders, too; they stand on the palm."""
    turn: TurnSpec = setting(TurnSpec(spin=2.0))
    """Goals that follow one another about an axis, and when each is reached."""
    support: str = setting("palm", choices=("palm", "fingers"))
    """palm: the palm carries the object; fingers: they hold it clear of the palm, and touching the palm is a drop."""
    tilt: float = setting(-0.2, unit="rad", low=-1.2, high=1.2)
    """Nominal pitch of the hand. Positive lets the object slide toward the wrist, which no finger reaches; negative
    returns it to the fingers."""
    roll: float = setting(-0.2, unit="rad", low=-1.2, high=1.2)
    """Nominal roll of the hand. Positive lets the object slide toward the thumb, where it falls over the palm's edge
    most easily."""
    reference: tuple[float, ...] = setting((), unit="m", low=-0.5, high=0.5)
    """Reference position of the object, where thumb and fingers meet; empty for the one that the hand's TOML gives."""
    drop_distance: float = setting(0.07, unit="m", low=0.01, high=1.0)
    """The object is lost when its centre is farther than this from the reference."""
    drop_tilt: float = setting(1.0, unit="rad", low=0.1, high=3.2)
    """The object is lost when it has tipped over: its own axis is farther than this from the axis of rotation, and no
    goal can be reached any more."""
    patience: float = setting(4.0, unit="s", low=0.1, high=1e6)
    """A training episode ends as a drop after this long without a new goal. Without this limit policies learn to turn
    once and then hold still. Evaluations have no such limit."""
    drop_radius: float = setting(0.055, unit="m", low=0.01, high=1.0)
    """A training episode ends as a drop when the object is farther than this from the reference. Without this limit
    some policies learn gaits that lose the object over the palm's edge. Evaluations use `drop_distance`."""
    episode_seconds: float = setting(20.0, unit="s", low=0.2, high=3600.0)
    """Training episode length. It is short, as most objects are lost in the first strokes."""
    evaluation_seconds: float = setting(120.0, unit="s", low=0.2, high=3600.0)
    """Evaluation episode length."""
    push_probability: float = setting(0.005, unit="1", low=0.0, high=1.0)
    """Probability per tick of a push on the object."""
    push_speed: float = setting(0.1, unit="m/s", low=0.0, high=5.0)
    """Largest change of the object's speed in a push."""
    posture: tuple[float, ...] = setting((), unit="rad", low=-3.2, high=3.2)
    """Joint angles that episodes start near; empty for those that the hand's TOML gives."""
    posture_noise: float = setting(0.3, unit="rad", low=0.0, high=1.0)
    """Largest deviation of the start posture from `posture`, per joint. It is wide, so that a stroke can begin where
    another ended."""
    curl: Range = setting((0.0, 0.0), unit="rad", low=-2.0, high=2.0)
    """Range added to all joints of the four fingers alike."""
    squeeze: Range = setting((0.0, 0.0), unit="rad", low=-1.0, high=1.0)
    """Range of the distance between joint targets and start posture of thumb and fingers: the grip."""
    start_offset: tuple[float, float] = setting((-0.018, -0.001), unit="m", low=-0.1, high=0.1)
    """Start position of the object, across and along the palm (y, z) from the reference: a little away from thumb and
    fingertips, beside which the first stroke often fails."""
    place_noise: float = setting(0.010, unit="m", low=0.0, high=0.05)
    """Largest shift of the object from its start position."""
    trap: float = setting(0.25, unit="1", low=0.0, high=1.0)
    """Share of the start states in which the object is stuck: ahead of the reference, tipped toward the wrist and held
    by the middle finger. Above 0, tipping and moving ahead cost in every tick, too."""
    observation: ObservationConfig = setting(ObservationConfig(add=("palm_gravity", "past_actions")))
    """What the policy sees. Which way the palm leans tells where a cube slides."""
    randomization: Randomization = setting(Randomization(latency=(0.0, 0.06)))
    """Properties of the hand that are drawn anew in every episode."""
    reward: RotateReward = setting(RotateReward(gate=0.04))
    """Reward weights. The gate closes before `turn.distance`."""

    def __post_init__(self):
        super().__post_init__()
        if len(self.reference) not in (0, 3):
            raise ConfigError(f"RotateConfig.reference = {self.reference}: expected 3 numbers")
        if other := set(self.objects.shapes) - {"box", "cylinder"}:
            raise ConfigError(f"RotateConfig.objects.shapes names {sorted(other)[0]!r}: expected box or cylinder")
        cubes = self.objects.shapes == ("box",) and self.proportions == (1.0, 1.0)
        if not cubes and (self.turn.axes or abs(self.turn.unit_axis[0]) < 1 - 1e-9):
            raise ConfigError("RotateConfig.turn.axis: boxes and cylinders turn about the palm's normal, (1, 0, 0)")

    def placed_on(self, hand: Hand) -> "RotateConfig":
        """These settings in the palm frame of this hand."""
        if hand.side == "right":
            return self
        across, along = self.start_offset
        return dataclasses.replace(
            self,
            roll=-self.roll,
            reference=mirror_point(self.reference),
            start_offset=(-across, along),
            turn=self.turn.mirror(),
        )


_PLAIN = RotateConfig(trap=0.0, observation=ObservationConfig(), randomization=Randomization())
"""Without what is known to help where a cube lies on the palm."""


def paper() -> RotateConfig:
    """The paper's rewards, success test and observations. What the paper gives no number for: docs/equations.md."""
    return dataclasses.replace(
        _PLAIN,
        turn=TurnSpec(),
        drop_distance=0.09,
        drop_tilt=math.pi,
        patience=1e6,
        drop_radius=1.0,
        control=Control(step=0.3),
        episode_seconds=60.0,
        skin=Skin(total="solver"),
        reward=RotateReward(
            goal=1.0, action=-0.0002, velocity=0.0, torque=0.0, spin=0.0, bonus_tips=0.0, bonus_speed=1e6, drop=0.0
        ),
    )


def without_orientation() -> RotateConfig:
    """The paper's second policy: the object's orientation is not observed."""
    config = RotateConfig()
    observation = dataclasses.replace(config.observation, leave_out=("relative_orientation",))
    control = dataclasses.replace(config.control, step=0.2)  # with 0.3 rad fewer turns reach the emulated hand
    return dataclasses.replace(config, observation=observation, control=control)


def any_object() -> RotateConfig:
    """Boxes and cylinders of unknown size, whose orientation is not observed, on a palm that leans as much as 0.4 rad
    either way from its nominal tilt."""
    return dataclasses.replace(
        _PLAIN,
        objects=ObjectConfig(shapes=("box", "cylinder"), mass=(0.06, 0.15), link_friction=(0.3, 0.9)),
        edge=(0.045, 0.065),
        proportions=(0.9, 1.1),
        randomization=Randomization(gravity_tilt=0.4),
        observation=ObservationConfig(leave_out=("relative_orientation",), add=("joint_torque",)),
    )


def clear_of_palm() -> RotateConfig:
    """The object held clear of the palm: it lies in the curled fingers, which point downhill, and turns about what is
    upright there."""
    return dataclasses.replace(
        _PLAIN,
        control=dataclasses.replace(_PLAIN.control, step=0.15),
        reward=RotateReward(goal=1.0, torque=-0.1, bonus_tips=0.0, gate=0.04),
        support="fingers",
        tilt=-1.1,
        roll=0.0,
        drop_radius=1.0,
        turn=TurnSpec(axis=(0.6, 0.0, -0.8), spin=2.0),
        reference=(0.072, 0.005, 0.098),
        squeeze=(0.0, 0.2),
        posture=(1.2, 0.3, 0.3, 0.0, 0.8, 0.6, 0.8, 0.6, 0.8, 0.6, 0.8, 0.6),
        posture_noise=0.2,
        start_offset=(0.0, 0.0),
        place_noise=0.006,
        curl=(-0.1, 0.1),
    )
