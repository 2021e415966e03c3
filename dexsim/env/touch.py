"""Touch of a tick: from where hand and object are, and how hard they press, to the taxels' forces."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from dexsim.core.errors import ConfigError
from dexsim.env.config import EnvConfig
from dexsim.geometry import grid, rotations, surface_points
from dexsim.geometry.vectors import length
from dexsim.hand.description import Hand
from dexsim.hand.kinematics import HandPose
from dexsim.objects.config import ObjectConfig, load_mesh_object
from dexsim.objects.params import ObjectParams
from dexsim.touch.taxel_force import Touch, compute_touch, project_on_normals


class TouchModel:
    """Taxels and skin of one environment's hand."""

    def __init__(self, config: EnvConfig, hand: Hand):
        self.config, self.hand = config, hand
        self.geometry = touch_geometry(config.objects, config.touch_method)
        # Whether the taxels' forces are those of the springs: the same geometry and rubber.
        same_rubber = config.skin.margin == config.physics.pad_thickness
        self._shared = config.touch_method == "closed_form" and same_rubber

    def compute(
        self,
        pose: HandPose,
        object: ObjectParams,
        position: jax.Array,
        rotation: jax.Array,
        force: jax.Array,
        pad_thickness_delta: jax.Array | float = 0.0,
    ) -> tuple[Touch, jax.Array, jax.Array]:
        """What presses on the fingertips in a tick.

        Args:
          pose: of the hand.
          object, position [3] m, rotation [3, 3]: the object and where it is, palm frame.
          force: [F, 3] N, of the object on the finger tips, palm frame.
          pad_thickness_delta: [] m, change of the rubber's thickness from `Skin.margin`.

        Returns:
          The taxels' depths and forces; the part [F] N of `force` that presses into the skin; the force [F] N, by the
          skin's law, for the contact's springs.
        """
        hand, skin, place = self.hand, self.config.skin, (position, rotation)
        touch = compute_touch(hand, pose, self.geometry(object), *place, length(force), skin, pad_thickness_delta)
        # In the links' frames, where the normals are constants.
        local = rotations.rotate_inverse(pose.tip_rotation, force)
        pressed = project_on_normals(touch, jnp.asarray(hand.taxel_normal), local)
        normal = jnp.sum(pressed.force, -1)
        touch = pressed if skin.total == "pressing" else touch
        if self._shared:
            return touch, normal, jnp.sum(touch.skin_force, -1)
        delta = jnp.maximum(pad_thickness_delta, -self.config.physics.pad_thickness)  # the solver's
        bearing = compute_touch(hand, pose, object.shape(), *place, jnp.ones(hand.num_fingers), skin, delta)
        return touch, normal, jnp.sum(bearing.skin_force, -1)


def touch_geometry(config: ObjectConfig, method: str) -> Callable[[ObjectParams], Any]:
    """A pure function from one episode's object to its geometry, as `dexsim.geometry.distance` takes it.

    The method is closed_form (the solver's primitives), grid (the mesh, baked) or surface_points (points on the mesh,
    or on the primitives at their drawn sizes).

    Raises:
      AssetError: the mesh cannot be baked.
      ConfigError: a grid of primitives, whose sizes are drawn anew in every episode.
    """
    if method == "closed_form":
        return ObjectParams.shape
    if not config.mesh:
        if method == "grid":
            raise ConfigError(
                "touch_method = 'grid': needs a mesh (ObjectConfig.mesh); choose closed_form or surface_points"
            )
        return lambda object: surface_points.from_shape(object.shape())
    mesh_object = load_mesh_object(config)
    module: Any = grid if method == "grid" else surface_points
    with jax.ensure_compile_time_eval():
        geometry = grid.bake(mesh_object.mesh) if method == "grid" else surface_points.from_mesh(mesh_object.mesh)
    return lambda object: module.scaled(geometry, object.size[0, 0] / mesh_object.boxes.size[0, 0])
