"""Settings of the sensors: latency, noise and counts between the truth and the host."""

import dataclasses

from dexsim.core.config import Config, setting
from dexsim.sensing.imu import ImuConfig
from dexsim.sensing.taxels import TaxelSensor


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
    velocity_filter: float = setting(0.5, unit="1", low=0.01, high=1.0)
    """Weight of the newest difference in the object's velocity estimate."""
    orientation: ImuConfig = setting(ImuConfig())
    """The IMU inside the object."""
    taxel: TaxelSensor = setting(TaxelSensor())
    """The taxels."""
