"""Signals and taxels as a recording for the rerun viewer (extra `rerun`)."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from dexsim.core.install import require
from dexsim.hand.description import Hand
from dexsim.render.panel import taxel_image


def show_rerun(
    hand: Hand, time: np.ndarray, series: Mapping[str, np.ndarray], taxel_force: np.ndarray, path: Path
) -> None:
    """Write signals [T, ...] by name at times [T] s, and taxels [T, F, N] N as pictures, in a recording at `path`.

    Raises:
      DexsimError: rerun is not installed.
      OSError: the file cannot be written.
    """
    require("rerun", "rerun", "a recording for the rerun viewer")
    import rerun

    recording = rerun.RecordingStream("dexsim")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.touch()  # Its error names the file; rerun's does not.
    recording.save(path)
    names = {hand.num_joints: hand.joint_names, hand.num_fingers: hand.finger_names}
    for entity, signal in series.items():
        values = signal.reshape(len(time), -1)
        labels = names.get(values.shape[1], [f"{entity} {i}" for i in range(values.shape[1])])
        recording.log(entity, rerun.SeriesLines(names=list(labels)), static=True)
        recording.send_columns(entity, [rerun.TimeColumn("run", duration=time)], rerun.Scalars.columns(scalars=values))
    top = max(float(np.max(taxel_force)), 1e-3)
    for at, force in zip(time, taxel_force, strict=True):
        recording.set_time("run", duration=float(at))
        for finger, name in enumerate(hand.finger_names):
            picture = taxel_image(force[finger], hand.taxel_grid)
            recording.log(f"taxels/{name}", rerun.DepthImage(picture, colormap="inferno", depth_range=(0.0, top)))
    recording.disconnect()
