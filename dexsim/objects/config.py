"""Which objects are drawn, and from which ranges."""

import dataclasses
from pathlib import Path

import numpy as np

from dexsim.core.config import Config, Range, setting
from dexsim.errors import ConfigError
from dexsim.geometry.mesh import REPAIRS
from dexsim.objects.mesh import MeshObject, load

SLOTS = ("box", "capsule", "cylinder")
"""Kinds of primitives; the template has those that the shapes asked for need, in this order."""
_SLOTS_OF: dict[str, tuple[str, ...]] = {
    "sphere": ("capsule",),
    "box": ("box",),
    "cylinder": ("cylinder",),
    "capsule": ("capsule",),
    "composition": SLOTS,
}
SHAPES = tuple(_SLOTS_OF)
KINDS = (*SHAPES, "mesh")
"""What `ObjectParams.shape_index` counts."""
INACTIVE_SIZE = 1e-4  # m, size of a slot that is switched off: at the object's centre
PROPERTY_RANGES = ("mass", "inertia_scale", "com_offset", "friction", "stiffness", "restitution", "link_friction")
"""Ranges of `ObjectConfig` that are drawn anew at every episode start, in the order of their random keys."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ObjectConfig(Config):
    """Which objects are drawn, and their ranges (low, high). Mass to restitution are drawn at every episode
    start, shape and sizes once for each start state of the pool, whose poses were chosen for them."""

    shapes: tuple[str, ...] = setting(SHAPES, choices=SHAPES)
    """Kinds of object, drawn with equal probability."""
    mesh: str = setting("")
    """File of a closed mesh (STL, OBJ, PLY, ...) that replaces `shapes`. Its z axis is across the
    fingers in a grasp, its x axis is normal to the palm in a rotation."""
    mesh_unit: float = setting(1.0, unit="m", low=1e-6, high=100.0)
    """Length of that file's unit: 0.001 for millimetres."""
    mesh_repair: str = setting("none", choices=REPAIRS)
    """What to do with a mesh that is not closed: take its voxel shell or its convex hull. The deviation is printed."""
    mesh_size: Range = setting((1.0, 1.0), unit="1", low=0.1, high=10.0)
    """Factor on the mesh's size."""
    mesh_parts: int = setting(6, unit="1", low=1, high=24)
    """Largest number of boxes that approximate the mesh in the solver; its cost grows with them."""
    sphere_radius: Range = setting((0.022, 0.035), unit="m", low=0.005, high=0.08)
    """Radius of a sphere."""
    box_half: Range = setting((0.020, 0.030), unit="m", low=0.005, high=0.08)
    """Each half-extent of a box."""
    cylinder_radius: Range = setting((0.020, 0.030), unit="m", low=0.005, high=0.08)
    """Radius of a cylinder or capsule."""
    cylinder_half: Range = setting((0.020, 0.035), unit="m", low=0.002, high=0.10)
    """Half-length of a cylinder, or of a capsule's straight part."""
    neck_radius: Range = setting((0.010, 0.016), unit="m", low=0.003, high=0.05)
    """Radius of the capsule that juts out of a composition."""
    neck_half: Range = setting((0.008, 0.018), unit="m", low=0.002, high=0.10)
    """Half-length of that capsule's straight part."""
    mass: Range = setting((0.05, 0.20), unit="kg", low=0.001, high=5.0)
    """Mass of the object."""
    inertia_scale: Range = setting((0.8, 1.25), unit="1", low=0.05, high=20.0)
    """Factor on the inertia of a uniform solid."""
    com_offset: float = setting(0.003, unit="m", low=0.0, high=0.05)
    """Largest offset of the centre of mass, per axis."""
    friction: Range = setting((0.4, 1.2), unit="1", low=0.01, high=5.0)
    """Sliding friction between the fingertips' rubber and the object."""
    link_friction: Range = setting((0.3, 1.2), unit="1", low=0.01, high=5.0)
    """Sliding friction between all else of the hand (palm, links) and the object."""
    stiffness: Range = setting((1600.0, 1800.0), unit="N/m", low=10.0, high=1e6)
    """Force over depth at rest of a fingertip's contact (`contact.BARE_SHARE` times that elsewhere). Fingertips
    follow their skin (`Physics.tip_stiffness`): the middle of the default is the skin as it is, and other values make
    it that much stiffer: wide ranges part the solver's forces from what the taxels feel."""
    restitution: Range = setting((0.03, 0.08), unit="1", low=0.0, high=0.9)
    """Coefficient of restitution: the damping of the contact, which also slows creep. Values
    below 0.024 act as 0.024."""
    extremes: float = setting(0.0, unit="1", low=0.0, high=1.0)
    """Share of objects with every value at an end of its range; see `dexsim.core.ranges`."""

    def __post_init__(self):
        super().__post_init__()
        if not self.shapes:
            raise ConfigError("ObjectConfig.shapes is empty: name at least one shape")

    @property
    def slots(self) -> tuple[str, ...]:
        """Primitives of the compiled template: those that its shapes need."""
        if self.mesh:
            return ("box",) * len(load_mesh_object(self).boxes.size)
        needed = {slot for shape in self.shapes for slot in _SLOTS_OF[shape]}
        return tuple(slot for slot in SLOTS if slot in needed)

    @property
    def largest(self) -> np.ndarray:
        """Upper bound [K, 3] of every slot's size, for the compiled template."""
        if self.mesh:
            return self.mesh_size[1] * load_mesh_object(self).boxes.size
        radius = max(self.cylinder_radius[1], self.sphere_radius[1], self.neck_radius[1])
        half = max(self.cylinder_half[1], self.neck_half[1])
        size = {
            "box": [self.box_half[1]] * 3,
            "capsule": [radius, half, 0.0],
            "cylinder": [self.cylinder_radius[1], self.cylinder_half[1], 0.0],
        }
        return np.array([size[slot] for slot in self.slots])


def load_mesh_object(config: ObjectConfig) -> MeshObject:
    """The mesh of `config`, fitted. Raises AssetError: see `dexsim.objects.mesh.load`."""
    file = Path(config.mesh).expanduser()
    changed = file.stat().st_mtime_ns if file.is_file() else 0
    unit, parts, repair = config.mesh_unit, config.mesh_parts, config.mesh_repair
    return load(str(file), unit=unit, parts=parts, repair=repair, changed=changed)
