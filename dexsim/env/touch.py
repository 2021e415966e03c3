"""Touch of a tick: from where hand and object are, and how hard they press, to the taxels' forces."""

import jax
import jax.numpy as jnp

from dexsim.env.config import EnvConfig
from dexsim.geometry import rotations
from dexsim.geometry.vectors import length
from dexsim.hand.description import Hand
from dexsim.hand.kinematics import HandPose
from dexsim.objects.params import ObjectParams
from dexsim.objects.touch_geometry import touch_geometry
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
