"""The limits that `dexsim_real.control.safety.Safety` keeps."""

import dataclasses

from dexsim.core.config import Config, setting


@dataclasses.dataclass(frozen=True, kw_only=True)
class SafetyConfig(Config):
    """Limits of the hand. Ages count from the time of the measurement or joint target."""

    margin: float = setting(0.03, unit="rad", low=0.0, high=0.5)
    """Distance of commands from the joints' end stops, at most half of a joint's range; motors that come on nearer to
    one begin there. What it cuts off a target does not count as a clip."""
    speed: float = setting(7.0, unit="rad/s", low=0.01, high=200.0)
    """Largest rate of change of a command, below the no-load speed of the slower joints (8.6 rad/s). A policy that
    changes targets by 0.2 rad every 0.03 s needs 6.7 rad/s; `rotate` asks for up to 10 and is clipped."""
    reach: float = setting(0.6, unit="rad", low=0.01, high=4.0)
    """Distance of a command from the measured angle beyond which it does not move farther away."""
    joint_speed: float = setting(10.0, unit="rad/s", low=0.1, high=1000.0)
    """Measured joint speed above which the hand holds; above `speed`, since a joint catches up with its command."""
    current: float = setting(1.8, unit="A", low=0.01, high=20.0)
    """Current of a joint above which the motors go off; the XHand reports 1.5 A when stalled at its usual limit."""
    current_seconds: float = setting(1.0, unit="s", low=0.0, high=60.0)
    """Time for which a joint may exceed `current`."""
    stall_current: float = setting(1.3, unit="A", low=0.01, high=20.0)
    """Current above which a joint that does not move is stalled. A stalled thumb reported 1.5 A, other joints 0.8 to
    1.1 A, which a firm grasp also needs."""
    stall_seconds: float = setting(3.0, unit="s", low=0.1, high=600.0)
    """Time after which the motors go off when a joint is stalled."""
    temperature: float = setting(70.0, unit="degC", low=20.0, high=150.0)
    """Temperature of a joint board, a fingertip or the palm board above which the motors go off."""
    alarm_seconds: float = setting(0.2, unit="s", low=0.0, high=60.0)
    """Time for which the hand holds while it reports an error or motors that are off, before they go off for good."""
    ignored_errors: tuple[int, int, int] = setting((0, 0, 0), unit="1", low=0, high=65535)
    """Error bits of palm, joint and tip board that are harmless on this hand, as sums of bits."""
    finger_force: float = setting(15.0, unit="N", low=0.1, high=1000.0)
    """Force of a fingertip (sum of its taxels) above which the hand holds; the XHand is specified for 15 N."""
    total_force: float = setting(70.0, unit="N", low=0.1, high=1000.0)
    """Force of all fingertips above which the hand holds; it is rated for 80 N."""
    stale: float = setting(0.05, unit="s", low=0.001, high=10.0)
    """Age of the newest measurement above which the hand holds."""
    stale_object: float = setting(0.3, unit="s", low=0.01, high=60.0)
    """Age of the newest camera or IMU measurement above which the hand holds."""
    watchdog: float = setting(0.08, unit="s", low=0.001, high=10.0)
    """Age of the newest joint target above which the hand holds, at least two control ticks."""
    patience: float = setting(1.0, unit="s", low=0.0, high=60.0)
    """Duration of a hold for lack of joint targets or measurements, also of the object, after which the motors go
    off."""
    slow_speed: float = setting(0.5, unit="rad/s", low=0.01, high=100.0)
    """Speed of commands once the motors are stiff or a hold ends, at most `speed`, to which it then grows."""
    ramp: float = setting(1.0, unit="s", low=0.01, high=60.0)
    """Time in which the speed of commands grows from `slow_speed` to `speed`."""
