"""Recomputes and plots the log of a run, and checks every observation against the recorded frames.

python -m dexsim_real.replay runs/real/....log --plot run.png
"""

import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import tyro

from dexsim_real.core.process import loading

with loading():
    from dexsim.core import cli
    from dexsim.datasets.lerobot import check_lerobot, write_lerobot
    from dexsim_real.control.controller import prepare_jax
    from dexsim_real.core.errors import HandError
    from dexsim_real.replay.plots import plot, trajectory, write_rerun
    from dexsim_real.replay.replay import replay


@dataclasses.dataclass(frozen=True, kw_only=True)
class ReplayArguments:
    """Options of `python -m dexsim_real.replay`."""

    log: Annotated[Path, tyro.conf.Positional]
    """Log file of `python -m dexsim_real.run`."""
    plot: Path | None = None
    """Image file for a figure of angles, forces and timing (.png, .pdf or .svg); None draws no figure."""
    rrd: Path | None = None
    """Recording for the rerun viewer (extra `rerun`); None writes no file."""
    lerobot: Path | None = None
    """Folder for a dataset of one episode in the LeRobot format (extra `lerobot`), which must not exist yet; None
    writes none."""
    hand: str = ""
    """The TOML of a hand of your own, where it is not in the place that the log names."""
    output: Path | None = None
    """JSON file for the report; None writes no file."""

    def __post_init__(self):
        if self.plot and self.plot.suffix.lower() not in (".png", ".pdf", ".svg"):
            raise HandError(f"--plot {self.plot}: give a file that ends in .png, .pdf or .svg")


def main(argv: Sequence[str] | None = None) -> int:
    """The command. Returns its exit code: 0, or 1 when a recomputed observation differs or none could be recomputed."""
    arguments = cli.parse(
        ReplayArguments,
        sys.argv[1:] if argv is None else argv,
        prog="python -m dexsim_real.replay",
        description="Recompute and plot the log of a run on the hand.",
    )
    outputs = {"--plot": arguments.plot, "--rrd": arguments.rrd, "--output": arguments.output}
    cli.check_apart(outputs, {"log": arguments.log, "TOML of the hand": arguments.hand})
    for path in filter(None, outputs.values()):
        cli.check_writable(path)
    if arguments.lerobot:
        check_lerobot(arguments.lerobot)
    prepare_jax()
    cli.enable_caches()
    run = replay(arguments.log, arguments.hand)
    report = run.report
    print(*report["notes"], sep="\n")
    print(
        f"{report['ticks']} ticks in {report['seconds']:.2f} s, {report['frames']} frames, "
        f"{report['damaged_bytes']} damaged bytes, end: {report['ended']}"
    )
    print(_verdict(report))
    if arguments.output:
        cli.write_json(arguments.output, report)
    if run.ticks and arguments.plot:
        plot(run, arguments.plot)
    if run.ticks and arguments.rrd:
        write_rerun(run, arguments.rrd)
    if run.ticks and arguments.lerobot:
        write_lerobot(arguments.lerobot, run.hand, report["task"], [trajectory(run)])
    return 0 if report["readings_same"] == report["observations_same"] == report["ticks"] > 0 else 1


def _verdict(report: dict[str, Any]) -> str:
    """One line on what was compared."""
    ticks, missing = report["ticks"], report["without_frame"]
    lacking = f"; {missing} ticks lack their frame (drivers given as sdk: log none)" if missing else ""
    if not ticks:
        return f"nothing could be compared{lacking}"
    if report["first_difference"] is None:
        return f"all observations agree to the last bit{lacking}"
    first = report["first_difference"]
    return f"{report['observations_same']} of {ticks} observations agree; first difference: {first}{lacking}"


if __name__ == "__main__":
    cli.run(main)
