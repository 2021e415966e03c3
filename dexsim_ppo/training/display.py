"""Live view of training: a panel of 80 columns on a terminal, plain lines elsewhere."""

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
_BARS = "▁▂▃▄▅▆▇█"
_PAST = 18  # returns in the sparkline


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
        self._live = (
            Live(console=self.console, refresh_per_second=4) if self.console.is_terminal and not quiet else None
        )
        self._known: dict[str, Any] = {}
        self._returns: list[float] = []

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
        self._known |= {k: v for k, v in row.items() if not (isinstance(v, float) and math.isnan(v))}
        if "episode/return" in self._known:
            self._returns = [*self._returns, self._known["episode/return"]][-_PAST:]
        cells = self._cells(self._known)
        if self._live:
            self._live.update(self._panel(cells), refresh=True)
        else:
            self.note(" | ".join(f"{name} {value}" for name, value in cells.items()))

    def _panel(self, cells: dict[str, str]) -> RenderableType:
        """Title, progress bar and times, and the other cells in two columns."""
        elapsed, left = self._known["seconds"], self._known["seconds_left"]
        width = min(self.console.width, _WIDTH)
        top = Table.grid(padding=(0, 2))
        if math.isfinite(left):
            total = max(elapsed + left, 1e-9)
            bar = ProgressBar(total, elapsed, width=width // 2)
            top.add_row(bar, f"{elapsed / total:.0%}, elapsed {duration(elapsed)}, left {cells.pop('left')}")
        else:
            top.add_row(f"elapsed {duration(elapsed)}")
            del cells["left"]
        table = Table.grid(padding=(0, 2), expand=True)
        for _ in range(2):
            table.add_column(style="dim", ratio=3)
            table.add_column(justify="right", ratio=4)
        entries = [(name, value) for name, value in cells.items()]
        if self._returns:
            entries.insert(0, ("return so far", sparkline(self._returns)))
        half = -(-len(entries) // 2)
        for first, second in zip(entries[:half], [*entries[half:], ("", "")], strict=False):
            table.add_row(*first, *second)
        frame = Table.grid()
        frame.add_column(width=width)
        frame.add_row(table)
        return Group(self._title, top, frame)

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


def sparkline(values: list[float]) -> str:
    """Numbers as bars of eight heights, the lowest and the highest of them at the ends of the scale."""
    low, high = min(values), max(values)
    top = len(_BARS) - 1
    return "".join(_BARS[round(top * (value - low) / (high - low)) if high > low else 0] for value in values)


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
