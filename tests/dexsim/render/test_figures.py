"""The figures show the numbers they were given."""

import dataclasses

import numpy as np
import pytest

from dexsim.hand.kinematics import forward_kinematics, taxel_positions
from dexsim.render.figures import draw_comparison, draw_taxels_3d, lattice_centre
from dexsim.render.render import draw_taxels


def presses(seed, frames=6):
    """Forces [T, F, N]: a few taxels of four fingers, the pinky never."""
    rng = np.random.default_rng(seed)
    force = rng.uniform(0, 2, (frames, 5, 120)) * (rng.random((frames, 5, 120)) < 0.1)
    force[:, 4] = 0
    return force


def test_lattice_centre_by_hand():
    force = np.zeros((2, 120))
    force[0, 3 * 12 + 5], force[0, 7 * 12 + 9] = 1.0, 3.0
    total, centre = lattice_centre(force, (10, 12))
    np.testing.assert_allclose(total, [4, 0])
    np.testing.assert_allclose(centre[0], [6, 8])
    assert np.all(np.isnan(centre[1]))


def test_comparison_shows_both_centres_and_forces(hand, tmp_path):
    first, second = presses(0), presses(1)
    figure = draw_comparison(
        hand, first, second, labels=("sim", "log"), times=0.1 * np.arange(6), path=tmp_path / "comparison.png"
    )
    assert (tmp_path / "comparison.png").stat().st_size > 5000
    axes = np.array(figure.axes).reshape(2, 5)
    for finger, name in enumerate(hand.finger_names):
        above, below = axes[:, finger]
        assert above.get_title() == name
        discs = above.collections[1:]
        for source, disc, line in zip((first, second), discs, below.lines, strict=True):
            total, centre = lattice_centre(source[:, finger], hand.taxel_grid)
            np.testing.assert_allclose(np.asarray(disc.get_offsets()), centre[total > 0])
            np.testing.assert_allclose(line.get_ydata(), total)
            # Areas are in proportion to the forces.
            sizes = disc.get_sizes()
            if finger < 4:
                np.testing.assert_allclose(sizes / sizes[0], total / total[0])
    assert len(axes[0, 4].collections[1].get_offsets()) == 0
    assert [t.get_text() for t in axes[1, 0].get_legend().get_texts()] == ["sim", "log"]


def test_one_frame_is_drawn_as_bars(hand):
    force = presses(2)[0]
    figure = draw_comparison(hand, force, 2 * force)
    heights = [bar.get_height() for bar in np.array(figure.axes).reshape(2, 5)[1, 0].patches]
    np.testing.assert_allclose(heights, [force[0].sum(), 2 * force[0].sum()])
    with pytest.raises(ValueError, match=r"\[5, 120\]"):
        draw_comparison(hand, force[:, :50], force[:, :50])


def test_a_hand_of_one_finger_has_figures(hand):
    one = dataclasses.replace(
        hand,
        finger_names=hand.finger_names[:1],
        **{name: getattr(hand, name)[:1] for name in ("taxel_position", "taxel_normal", "taxel_area")},
    )
    force = presses(2)[:, :1]
    assert [axis.get_title() for axis in draw_comparison(one, force, force).axes] == ["thumb", ""]
    figure = draw_taxels(one, force[0])
    assert [axis.get_title().split()[0] for axis in figure.axes if axis.images] == ["thumb"]


def test_taxels_in_space(hand, tmp_path):
    joints, force = np.full(12, 0.4, np.float32), presses(3)[0]
    figure = draw_taxels_3d(hand, joints, force, path=tmp_path / "taxels.png")
    assert (tmp_path / "taxels.png").stat().st_size > 5000
    dots = figure.axes[0].collections[0]
    order = np.argsort(force.reshape(-1))
    place = np.asarray(taxel_positions(hand, forward_kinematics(hand, joints))).reshape(-1, 3)[order]
    np.testing.assert_allclose(np.stack(dots._offsets3d, -1), place, atol=1e-7)
    np.testing.assert_allclose(dots.get_array(), force.reshape(-1)[order])
    with pytest.raises(ValueError, match="600 taxels"):
        draw_taxels_3d(hand, joints, force[:3])
