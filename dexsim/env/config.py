"""What every task configures: from physics to what the policy sees."""

import dataclasses

from dexsim.control import Control
from dexsim.core.config import Config, setting
from dexsim.geometry.distance import METHODS
from dexsim.objects.config import ObjectConfig
from dexsim.observation import ObservationConfig
from dexsim.physics.config import PhysicsConfig
from dexsim.randomization import Randomization
from dexsim.sensing.config import Sensing
from dexsim.touch.skin import Skin


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
