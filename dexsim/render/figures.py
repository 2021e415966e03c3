"""Figures of touch for papers and notebooks, in matplotlib: two sources compared, and the hand's taxels in space.

Both return a figure that is not shown by itself; `figure.savefig(path)` writes it. Shapes: T frames, F fingers, N
taxels.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from dexsim.hand.kinematics import Hand, forward_kinematics, taxel_positions

COLORS = ("#1f77b4", "#d95f02")
_LARGEST = 260.0  # pt^2, of a centre's disc


def draw_comparison(
    hand: Hand,
    first: np.ndarray,
    second: np.ndarray,
    *,
    labels: tuple[str, str] = ("simulation", "hand"),
    times: np.ndarray | None = None,
    path: Any = None,
):
    """Contact centres and magnitudes of two sources, overlaid (the paper's comparison of simulation and hand).

    Above, each finger's unrolled taxels with the force-weighted centres of both sources: a disc's area is the finger's
    force, a line joins the two centres of a frame. Below, the fingers' forces over time, or as bars for one frame.

    Args:
      first, second: taxel forces [F, N] or [T, F, N], N.
      times: [T] s; frames are numbered where it is left out.
      path: also write the figure there.

    Raises:
      ValueError: shapes that differ or are not the hand's.
    """
    import matplotlib.pyplot as plt

    sources = [np.asarray(source, float) for source in (first, second)]
    shape = (hand.num_fingers, hand.num_taxels)
    if sources[0].shape != sources[1].shape or sources[0].shape[-2:] != shape or sources[0].ndim not in (2, 3):
        raise ValueError(
            f"draw_comparison: forces {sources[0].shape} and {sources[1].shape}, expected two of "
            f"[{shape[0]}, {shape[1]}] or [T, {shape[0]}, {shape[1]}]"
        )
    sources = [source.reshape(-1, *shape) for source in sources]
    largest = max(float(source.sum(-1).max(initial=0)) for source in sources) or 1.0
    figure, axes = plt.subplots(
        2,
        shape[0],
        figsize=(2.1 * shape[0], 5.2),
        layout="constrained",
        squeeze=False,
        sharey="row",
        gridspec_kw={"height_ratios": (3, 2)},
    )
    plt.close(figure)
    columns, rows = hand.taxel_grid
    lattice = np.stack(np.divmod(np.arange(columns * rows), rows), -1)
    for finger, name in enumerate(hand.finger_names):
        above, below = axes[0, finger], axes[1, finger]
        above.scatter(*lattice.T, s=4, color="0.8", zorder=1)
        centres = []
        for source, color, label in zip(sources, COLORS, labels, strict=True):
            force, centre = lattice_centre(source[:, finger], hand.taxel_grid)
            centres.append(centre)
            felt = force > 0
            above.scatter(
                *centre[felt].T,
                s=_LARGEST * force[felt] / largest,
                color=color,
                alpha=0.45,
                lw=0.8,
                edgecolor=color,
                zorder=3,
                label=label,
            )
            _draw_forces(below, force, times, color, label)
        for start, end in zip(*centres, strict=True):
            above.plot(*np.stack([start, end]).T, color="0.35", lw=0.6, zorder=2)
        above.set(title=name, xlim=(-0.7, columns - 0.3), ylim=(-0.7, rows - 0.3), xlabel="column", aspect="equal")
        below.set(xlabel=("time [s]" if times is not None else "frame") if len(sources[0]) > 1 else "")
    axes[0, 0].set_ylabel("row (tip at the top)")
    axes[1, 0].set_ylabel("finger force [N]")
    axes[1, 0].legend(fontsize="small", frameon=False)
    if path is not None:
        figure.savefig(path, dpi=150)
    return figure


def draw_taxels_3d(
    hand: Hand,
    joint_position: np.ndarray,
    taxel_force: np.ndarray,
    *,
    ax: Any = None,
    force_range: float | None = None,
    elevation: float = 20.0,
    azimuth: float = 25.0,
    path: Any = None,
):
    """The posed hand's taxels in space, coloured by force, over a skeleton of its links.

    Args:
      joint_position: [J] rad.
      taxel_force: [F, N] N.
      ax: 3-D axes to draw into; a new figure where left out.
      force_range: force of the hottest colour, N; the largest one where left out.
      elevation, azimuth: of the camera, deg; the palm's normal is +x, fingers point to +z.
      path: also write the figure there.
    """
    import matplotlib.pyplot as plt

    pose = forward_kinematics(hand, np.asarray(joint_position, np.float32))
    taxels = np.asarray(taxel_positions(hand, pose)).reshape(-1, 3)
    force = np.asarray(taxel_force, float).reshape(-1)
    if len(force) != len(taxels):
        raise ValueError(f"draw_taxels_3d: {len(force)} forces, the hand has {len(taxels)} taxels")
    if ax is None:
        figure = plt.figure(figsize=(5.5, 5.5), layout="constrained")
        plt.close(figure)
        ax = figure.add_subplot(projection="3d")
    body, tips = np.asarray(pose.body_position), np.asarray(pose.tip_position)
    for index, above in enumerate(hand.body_parent):
        if above >= 0:
            ax.plot(*np.stack([body[above], body[index]]).T, color="0.6", lw=2)
    for finger, tip in enumerate(tips):
        ax.plot(*np.stack([body[hand.tip_body[finger]], tip]).T, color="0.6", lw=2)
    order = np.argsort(force)  # the loaded ones last, on top
    dots = ax.scatter(
        *taxels[order].T,
        c=force[order],
        s=4 + 22 * (force[order] > 0),
        cmap="YlOrRd",
        vmin=0,
        vmax=force_range or float(force.max()) or 1.0,
        depthshade=False,
    )
    ax.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]")
    ax.set_aspect("equal")
    ax.locator_params(nbins=4)
    ax.view_init(elevation, azimuth)
    ax.figure.colorbar(dots, ax=ax, label="force per taxel [N]", shrink=0.6)
    if path is not None:
        ax.figure.savefig(path, dpi=150)
    return ax.figure


def lattice_centre(force: np.ndarray, grid: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Total [T] N and force-weighted centre [T, 2] in (column, row) of one finger [T, N]; NaN without force."""
    place = np.stack(np.divmod(np.arange(grid[0] * grid[1]), grid[1]), -1)
    total = force.sum(-1)
    centre = force @ place / np.where(total > 0, total, 1.0)[:, None]
    return total, np.where(total[:, None] > 0, centre, np.nan)


def _draw_forces(axis: Any, force: np.ndarray, times: np.ndarray | None, color: str, label: str) -> None:
    if len(force) == 1:
        axis.bar(label, force[0], color=color, alpha=0.7, label=label)
        axis.tick_params(axis="x", labelrotation=30, labelsize="small")
    else:
        axis.plot(np.arange(len(force)) if times is None else times, force, color=color, lw=1.2, label=label)
