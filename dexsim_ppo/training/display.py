"""Live view of training: a panel of 80 columns on a terminal, plain lines elsewhere."""

import itertools
import math
from typing import Any

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.spinner import Spinner
from rich.table import Table

# (heading, metric, format). Metrics that the task does not have are left out.
COLUMNS = (
    ("return", "episode/return", ".2f"),
    ("success", "episode/success", ".1%"),
    ("goals", "episode/successes", ".1f"),
    ("length", "episode/length", ".0f"),
    ("reward", "reward", ".3f"),
    ("KL", "kl", ".4f"),
    ("lr", "learning_rate", ".1e"),
    ("std", "action_std", ".2f"),
)
_WIDTH = 80


class Display:
    """Shows rows of metrics; use as a context manager.

    Args:
      title: the task and the device.
      quiet: show nothing.
    """

    def __init__(self, title: str, quiet: bool = False):
        self.console = Console()
        self.console.quiet = quiet
        self._title = title
        self._live = Live(console=self.console) if self.console.is_terminal and not quiet else None
        self._latest: dict[str, Any] = {}

    def __enter__(self) -> "Display":
        if self._live:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live:
            self._live.stop()

    def note(self, text: str) -> None:
        """Print a line above the panel."""
        self.console.print(text, highlight=False, markup=False, soft_wrap=True)

    def working(self, text: str) -> None:
        """Say what is being waited for, until the next metrics."""
        if self._live:
            self._live.update(Spinner("dots", text=text), refresh=True)
        else:
            self.note(text)

    def show(self, row: dict[str, Any]) -> None:
        """Show the newest metrics. A NaN (no episode has ended) keeps the last value."""
        self._latest |= {k: v for k, v in row.items() if not (isinstance(v, float) and math.isnan(v))}
        cells = self._cells(self._latest)
        if self._live:
            self._live.update(self._panel(cells), refresh=True)
        else:
            self.note(" | ".join(f"{name} {value}" for name, value in cells.items()))

    def _panel(self, cells: dict[str, str]) -> RenderableType:
        """Title, progress bar and times, and the other cells in two columns."""
        elapsed, left = self._latest["seconds"], self._latest["seconds_left"]
        times, total = f"elapsed {duration(elapsed)}", max(elapsed + left, 1e-9)
        top = Table.grid(padding=(0, 2))
        if math.isfinite(left):
            bar = ProgressBar(total, elapsed, width=min(self.console.width, _WIDTH) // 2)
            top.add_row(bar, f"{elapsed / total:.0%}, {times}, left {duration(left)}")
        else:
            top.add_row(times)
        table = Table.grid(padding=(0, 3))
        entries = [entry for entry in cells.items() if entry[0] != "left"]
        half = -(-len(entries) // 2)
        for first, second in itertools.zip_longest(entries[:half], entries[half:], fillvalue=("", "")):
            table.add_row(*first, *second)
        return Group(self._title, top, table)

    @staticmethod
    def _cells(row: dict[str, Any]) -> dict[str, str]:
        cells = {
            "iteration": f"{row['iteration']}",
            "steps": count(row["env_steps"]),
            "steps/s": count(row["env_steps_per_s"]),
            "left": duration(row["seconds_left"]),
        }
        errors = sorted(k for k in row if k.startswith("step/") and k.endswith("error"))
        extra = tuple((k.removeprefix("step/").replace("_", " "), k, ".3f") for k in errors[:1])
        for heading, name, style in (*COLUMNS[:4], *extra, *COLUMNS[4:]):
            if name in row:
                cells[heading] = format(row[name], style)
        # Only what went wrong is shown.
        if row.get("skipped_updates"):
            cells["skipped updates"] = f"{row['skipped_updates']:.0f} of {row['updates']:.0f}"
        for kind in ("nonfinite", "bounded"):
            if row.get(f"total/{kind}_rewards"):
                cells[f"{kind} rewards"] = f"{row[f'total/{kind}_rewards']:.0f}"
        return cells


def count(x: float) -> str:
    """1234567 as 1.23M."""
    for limit, letter in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if x >= limit:
            return f"{x / limit:.3g}{letter}"
    return f"{x:.3g}"


def duration(seconds: float) -> str:
    """75 as 1:15; a number that is not finite as a dash."""
    if not math.isfinite(seconds):
        return "-"
    minutes, seconds = divmod(max(0, round(seconds)), 60)
    return f"{minutes}:{seconds:02d}"
