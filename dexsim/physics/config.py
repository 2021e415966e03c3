"""Settings of the physics: time step, solver and contacts."""

import dataclasses

from dexsim.core.config import setting, validate
from dexsim.core.errors import ConfigError


@dataclasses.dataclass(frozen=True, kw_only=True)
class PhysicsConfig:
    """Time step, solver and contact model."""

    timestep: float = setting(0.006, unit="s", low=1e-4, high=0.02)
    """One physics sub-step."""
    substeps: int = setting(5, unit="1", low=1, high=200)
    """Sub-steps in one control tick; the control rate is 1 / (timestep * substeps)."""
    iterations: int = setting(3, unit="1", low=1, high=100)
    """Newton iterations of the contact solver."""
    line_search: int = setting(6, unit="1", low=1, high=100)
    """Line-search iterations in each of them."""
    condim: int = setting(3, unit="1", low=1, high=6)
    """Contact dimension between hand and object: 3 sliding, 4 with torsion, 6 with rolling."""
    cone: str = setting("elliptic", choices=("elliptic", "pyramidal"))
    """Friction cone. A pyramid is a linear approximation, and what it holds creeps: at half of what
    friction can bear by 12 to 25 mm/s here (tests/test_contact.py), through the fingers in seconds."""
    friction_ratio: float = setting(20.0, unit="1", low=0.1, high=1000.0)
    """How much harder an elliptic cone resists sliding than penetration (MuJoCo's impratio)."""
    cover: float = setting(0.003, unit="m", low=0.0, high=0.01)
    """Rubber over the fingertips: their geoms, which follow the taxels, touch this far out. Keep it
    equal to `Skin.margin`, so that solver and taxels begin to feel at the same distance."""
    pad_points: int = setting(3, unit="1", low=1, high=8)
    """Spheres in a row that stand for each capsule of a fingertip against the object."""
    tips: str = setting("skin", choices=("skin", "constant"))
    """Stiffness of the fingertips: as the skin's law over the taxels has it, by the tick, which makes
    edges softer than faces; or the same everywhere."""
    settling: float = setting(0.03, unit="s", low=0.005, high=0.2)
    """Time scale on which a contact pushes out what lies in it (at least four time steps)."""
    palm: str = setting("auto", choices=("auto", "face", "box"))
    """Palm as its box, or as a half-space at its face, which carries an object beside the palm, too, but meets every
    primitive in closed form. auto: the box where the object has no cylinder or ellipsoid."""
    contacts: str = setting("closed", choices=("closed", "mjx"))
    """JAX backend only. closed: MJX's rigid bodies with our closed-form contacts and solver, where the
    scene allows (`dexsim.physics.jax_backend.substep`); mjx: `mjx.step` throughout, some six times slower on a CPU."""
    max_contacts: int = setting(20, unit="1", low=4, high=400)
    """Contacts kept per environment (JAX backend: the deepest; Warp: mean over the batch)."""

    def __post_init__(self):
        validate(self)
        if self.condim not in (1, 3, 4, 6):
            raise ConfigError(f"PhysicsConfig.condim = {self.condim}: must be 1, 3, 4 or 6")

    @property
    def control_period(self) -> float:
        """One control tick, s."""
        return self.timestep * self.substeps

    @property
    def pyramid_edges(self) -> int:
        """Edges of a contact's friction pyramid; 0 for an elliptic cone, and without friction."""
        return 2 * (self.condim - 1) if self.cone == "pyramidal" else 0

    @property
    def contact_period(self) -> float:
        """`settling`, s, as far as the time step allows."""
        return max(self.settling, 4 * self.timestep)
