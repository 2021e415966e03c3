"""The status of a run on the terminal: a live table, or a line every few seconds when the output is no terminal."""

import threading
from collections import deque
from collections.abc import Callable
from typing import Any

from rich.console import Console
from rich.live import Live
from rich.table import Table

from dexsim_real.core.process import lower_priority

_LIVE, _LINES = 0.25, 5.0  # s between two updates of the table, and between two lines


class StatusView:
    """Shows `status()` from a background thread. A context manager.

    Args:
      title: of the table.
      status: returns the rows of the table, name to text; called from the background thread.
      quiet: show nothing.
    """

    def __init__(self, title: str, status: Callable[[], dict[str, str]], quiet: bool = False):
        self.console = Console(stderr=True, quiet=quiet)
        self._title, self._status = title, status
        self._live = (
            Live(console=self.console, auto_refresh=False, transient=True)
            if (self.console.is_terminal and not quiet)
            else None
        )
        self._notes: deque[str] = deque(maxlen=1000)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="view", daemon=True)

    def __enter__(self) -> "StatusView":
        if self._live:
            self._live.start()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join(2.0)
        if self._live:
            self._live.stop()

    def note(self, text: str) -> None:
        """Print a line. While the view runs, its thread does, so the caller never waits for a terminal."""
        self._notes.append(text)
        if not self._thread.is_alive():
            self._print_notes()

    def _print_notes(self) -> None:
        while self._notes:
            self.console.print(self._notes.popleft(), highlight=False, markup=False, soft_wrap=True)

    def _run(self) -> None:
        lower_priority()
        shown = 0.0
        while not self._stop.wait(_LIVE):
            self._print_notes()
            shown += _LIVE
            if self._live:
                self._live.update(self._table(self._status()), refresh=True)
            elif shown >= _LINES:
                shown = 0.0
                self._notes.append(" | ".join(f"{name} {value}" for name, value in self._status().items()))
        self._print_notes()

    def _table(self, status: dict[str, str]) -> Table:
        table = Table(show_header=False, title=self._title, title_justify="left")
        for row in status.items():
            table.add_row(*row)
        return table


def summary_table(title: str, summary: dict[str, Any]) -> Table:
    """A table of nested results."""
    table = Table("measure", "value", title=title, title_justify="left")
    for name, value in summary.items():
        if isinstance(value, dict):
            value = ", ".join(f"{k} {_short(v)}" for k, v in value.items() if v not in (0, {}))
        table.add_row(name.replace("_", " "), _short(value))
    return table


def _short(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
