"""Touch of a tick: from where hand and object are, and how hard they press, to the taxels' forces."""

import jax
import jax.numpy as jnp

from dexsim.core.pytree import pytree_dataclass
from dexsim.env.config import EnvConfig
from dexsim.geometry import rotations
from dexsim.geometry.vectors import length
from dexsim.hand.kinematics import Hand, HandPose, taxel_normals
from dexsim.objects.params import ObjectParams
from dexsim.objects.touch_geometry import touch_geometry
from dexsim.touch.feel import Touch, feel_links, keep_normal_part, split_force, taxel_share
from dexsim.touch.surface import taxels_only, whole_surface


@pytree_dataclass
class FingertipTouch:
    """What the fingertips feel in a tick; F fingers, N taxels."""

    touch: Touch  # [F, N]
    normal_force: jax.Array  # [F] N, what of the finger's force presses into its skin, with or without taxels
    tangential_force: jax.Array | None  # [F, 3] N along the taxels, with three-axis taxels


class TouchModel:
    """Taxels and skin of one environment's hand. Pure methods."""

    def __init__(self, config: EnvConfig, hand: Hand):
        self.config, self.hand = config, hand
        self._surface = whole_surface(hand, config.skin.thickness) if config.skin.untaxelled else taxels_only(hand)
        self.geometry = touch_geometry(config.objects, config.touch_method)

    def feel(
        self,
        pose: HandPose,
        object: ObjectParams,
        position: jax.Array,
        quat: jax.Array,
        force: jax.Array,
        cover: jax.Array | float = 0.0,
    ) -> FingertipTouch:
        """The taxels' forces.

        Args:
          pose: of the hand.
          object, position [3] m, quat [4]: the object and where it is, palm frame.
          force: [F, 3] N, of the object on the finger tips, palm frame.
          cover: [] m, change of the rubber's thickness from `Skin.margin`.
        """
        hand, config = self.hand, self.config
        if config.touch:
            touch, normal, share = self._press(pose, object, position, quat, force, cover)
        else:
            nothing, normal, share = jnp.zeros(hand.taxel_area.shape), jnp.zeros(hand.num_fingers), 0.0
            touch = Touch(nothing, nothing, nothing)
        if not config.three_axis:
            return FingertipTouch(touch, normal, None)
        return FingertipTouch(touch, normal, split_force(touch.force, taxel_normals(hand, pose), share * force)[1])

    def _press(
        self,
        pose: HandPose,
        object: ObjectParams,
        position: jax.Array,
        quat: jax.Array,
        force: jax.Array,
        cover: jax.Array | float,
    ) -> tuple[Touch, jax.Array, jax.Array | float]:
        """The touch, the normal forces [F] N, and the share [F, 1] of each finger's load that the taxels bear."""
        hand, skin, surface = self.hand, self.config.skin, self._surface
        touch = feel_links(
            hand,
            pose,
            self.geometry(object),
            position,
            rotations.quat_to_matrix(quat),
            length(force),
            skin,
            surface,
            cover,
        )
        # In the links' frames, where the normals are constants.
        local = rotations.rotate_inverse(pose.tip_rotation, force)
        pressed = keep_normal_part(touch, jnp.asarray(surface.normal), local)
        if skin.total == "pressing":
            touch = pressed
        share = taxel_share(touch.skin_force, hand.num_taxels) if skin.untaxelled else 1.0
        return jax.tree.map(lambda x: x[:, : hand.num_taxels], touch), jnp.sum(pressed.force, -1), share
