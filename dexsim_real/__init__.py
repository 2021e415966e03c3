"""The bridge to a real hand: frames, driver, readings, safety limits, log and replay, control loop.

`python -m dexsim_real.run` runs a policy on a hand; docs/hardware.md is the manual. The bridge needs neither a GPU
nor MJX, and pyserial only where a port is opened. Names are imported at first use.
"""

from typing import TYPE_CHECKING

from dexsim.core.lazy_loading import lazy_exports

if TYPE_CHECKING:
    from dexsim_real.control.controller import Controller as Controller
    from dexsim_real.control.limits import SafetyConfig as SafetyConfig
    from dexsim_real.control.safety import Safety as Safety
    from dexsim_real.core.errors import HandError as HandError
    from dexsim_real.run import RunResult as RunResult, run_policy as run_policy
    from dexsim_real.wire.driver import (
        DriverState as DriverState,
        HandDriver as HandDriver,
        JointTargets as JointTargets,
        open_port as open_port,
    )
    from dexsim_real.wire.link import LinkConfig as LinkConfig, SerialHand as SerialHand


__all__, __getattr__, __dir__ = lazy_exports(__name__)
