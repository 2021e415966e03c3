"""Touch of a tick: from where hand and object are, and how hard they press, to the taxels' forces."""

import jax
import jax.numpy as jnp

from dexsim.env.config import EnvConfig
from dexsim.geometry import rotations
from dexsim.geometry.vectors import length
from dexsim.hand.kinematics import Hand, HandPose
from dexsim.objects.params import ObjectParams
from dexsim.objects.touch_geometry import touch_geometry
from dexsim.touch.surface import skin_surface, taxels_only, whole_surface
from dexsim.touch.taxel_force import Touch, compute_touch, project_on_normals


class TouchModel:
    """Taxels and skin of one environment's hand."""

    def __init__(self, config: EnvConfig, hand: Hand):
        skin = config.skin
        self.config, self.hand = config, hand
        self._surface = whole_surface(hand, skin.thickness) if skin.untaxelled else taxels_only(hand)
        self._bearing = skin_surface(hand, skin)
        self.geometry = touch_geometry(config.objects, config.touch_method)
        # Whether the taxels' forces are those of the springs: the same points, geometry and rubber.
        same_rubber = skin.margin == config.physics.pad_thickness
        self._shared = config.touch_method == "closed_form" and not skin.untaxelled and same_rubber

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
          The taxels' depths and forces; the part [F] N of `force` that presses into the skin, with or without taxels;
          the force [F] N, by the skin's law, of all skin that bears load, for the contact's springs.
        """
        hand, skin, place = self.hand, self.config.skin, (position, rotation)
        surface, geometry = self._surface, self.geometry(object)
        touch = compute_touch(hand, pose, geometry, *place, length(force), skin, surface, pad_thickness_delta)
        # In the links' frames, where the normals are constants.
        local = rotations.rotate_inverse(pose.tip_rotation, force)
        pressed = project_on_normals(touch, jnp.asarray(surface.normal), local)
        normal = jnp.sum(pressed.force, -1)
        touch = pressed if skin.total == "pressing" else touch
        if self._shared:
            return touch, normal, jnp.sum(touch.skin_force, -1)
        delta = jnp.maximum(pad_thickness_delta, -self.config.physics.pad_thickness)  # the solver's
        unit = jnp.ones(hand.num_fingers)
        bearing = compute_touch(hand, pose, object.shape(), *place, unit, skin, self._bearing, delta)
        touch = jax.tree.map(lambda x: x[:, : hand.num_taxels], touch)
        return touch, normal, jnp.sum(bearing.skin_force, -1)
