"""What every task configures: from physics to what the policy sees."""

import dataclasses

from dexsim.control import Control
from dexsim.core.config import Config, setting
from dexsim.geometry.distance import METHODS
from dexsim.objects.config import ObjectConfig
from dexsim.observation import ObservationConfig
from dexsim.physics.config import PhysicsConfig
from dexsim.randomization import Randomization
from dexsim.sensing.imu import ImuConfig
from dexsim.sensing.taxels import TaxelSensor
from dexsim.touch.skin import Skin


@dataclasses.dataclass(frozen=True, kw_only=True)
class Sensing(Config):
    """Noise, filtering and resolution of what the hand measures."""

    joint_noise: float = setting(0.003, unit="rad", low=0.0, high=0.5)
    """White noise on joint angles."""
    joint_resolution: float = setting(0.0005, unit="rad", low=0.0, high=0.1)
    """Step of a joint angle reading (12 bits over a turn and a gear); 0 for none."""
    torque_noise: float = setting(0.01, unit="1", low=0.0, high=1.0)
    """White noise on normalised joint torque."""
    object_noise: float = setting(0.002, unit="m", low=0.0, high=0.1)
    """White noise on the object's position."""
    object_axes: tuple[bool, bool, bool] = setting((True, False, False))
    """Which coordinates of the object are measured; the others are fixed at the reference, as
    in the paper, where the camera gives only the height."""
    orientation: ImuConfig = setting(ImuConfig())
    """The IMU inside the object."""
    taxel: TaxelSensor = setting(TaxelSensor())
    """The taxels."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class EnvConfig(Config):
    """What every task configures."""

    physics: PhysicsConfig = setting(PhysicsConfig())
    """Time step, solver and contact model."""
    objects: ObjectConfig = setting(ObjectConfig())
    """What is held."""
    randomization: Randomization = setting(Randomization())
    """What is drawn at every episode start."""
    control: Control = setting(Control())
    """From action to joint target."""
    sensing: Sensing = setting(Sensing())
    """From truth to readings."""
    skin: Skin = setting(Skin())
    """The rubber over the taxels."""
    observation: ObservationConfig = setting(ObservationConfig())
    """What the policy sees."""
    pool_size: int = setting(2048, unit="1", low=1, high=1_000_000)
    """Start states generated once; every episode starts from one of them. An evaluation generates its own."""
    touch_method: str = setting("closed_form", choices=METHODS)
    """How far a taxel is from the object: closed forms of the solver's primitives (for a mesh: of the boxes that
    follow it), a grid baked from the mesh, or the nearest of points on the surface, as in the paper."""
