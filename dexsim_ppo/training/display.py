"""Live view of training: a table on a terminal, plain lines elsewhere."""

import math
from typing import Any

from rich.console import Console
from rich.live import Live
from rich.table import Table

# (heading, metric, format). Metrics that the task does not have are left out.
COLUMNS = (
    ("return", "episode/return", ".2f"),
    ("success", "episode/success", ".1%"),
    ("goals/min", "episode/goals_per_minute", ".1f"),
    ("length", "episode/length", ".0f"),
    ("reward", "reward", ".3f"),
    ("KL", "kl", ".4f"),
    ("lr", "learning_rate", ".1e"),
    ("std", "action_std", ".2f"),
)


class Display:
    """Shows rows of metrics; use as a context manager.

    Args:
      title: the task and the device.
    """

    def __init__(self, title: str):
        self.console = Console()
        self._title = title
        self._live = Live(console=self.console, auto_refresh=False) if self.console.is_terminal else None
        self._known: dict[str, Any] = {}

    def __enter__(self) -> "Display":
        if self._live:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live:
            self._live.stop()

    def note(self, text: str) -> None:
        """Print a line above the table."""
        self.console.print(text, highlight=False, markup=False, soft_wrap=True)

    def show(self, row: dict[str, Any]) -> None:
        """Show the newest metrics. A NaN (no episode has ended) keeps the last value."""
        self._known |= {k: v for k, v in row.items() if not (isinstance(v, float) and math.isnan(v))}
        cells = self._cells(self._known)
        if self._live:
            table = Table(*cells, title=self._title, title_justify="left")
            table.add_row(*cells.values())
            self._live.update(table, refresh=True)
        else:
            self.note(" | ".join(f"{name} {value}" for name, value in cells.items()))

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
