"""The status of a run on the terminal: live tables, or only notes when the output is no terminal."""

import contextlib
import sys
import threading
from collections import deque
from collections.abc import Callable
from typing import Any, TextIO, cast

import numpy as np
from rich import box
from rich.console import Console, Group
from rich.live import Live
from rich.markup import escape
from rich.table import Table

from dexsim.hand.description import Hand
from dexsim_real.core.process import BACKGROUND, change_priority
from dexsim_real.sensors.hand import HandMeasurement

_LIVE = 0.25  # s between two updates of the tables


class _Lasting:
    """A stream to which writing never fails: a terminal that was closed, or a pipe without a reader, ends no run."""

    def __init__(self, stream: TextIO):
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        with contextlib.suppress(OSError):
            self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        with contextlib.suppress(OSError):
            self._stream.flush()


class StatusView:
    """Shows the state of a run from a background thread, which calls `summary` and `hand`. A context manager."""

    def __init__(
        self,
        title: str,
        summary: Callable[[], dict[str, Any]],
        hand: Callable[[], Table | str],
        quiet: bool = False,
    ):
        self.console = _console(quiet)
        self._title, self._summary, self._hand = title, summary, hand
        live = self.console.is_terminal and not quiet
        self._live = Live(console=self.console, auto_refresh=False, transient=True) if live else None
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

    def show(self) -> None:
        """Print the tables once."""
        self.console.print(self._tables())

    def _print_notes(self) -> None:
        with contextlib.suppress(IndexError):  # Another thread may have printed the last one.
            while True:
                self.console.print(self._notes.popleft(), highlight=False, markup=False, soft_wrap=True)

    def _run(self) -> None:
        change_priority(BACKGROUND)
        while not self._stop.wait(_LIVE):
            self._print_notes()
            if self._live:
                self._live.update(self._tables(), refresh=True)
        self._print_notes()

    def _tables(self) -> Group:
        return Group(self._hand(), "", _rows(self._title, self._summary()))


def show_summary(title: str, summary: dict[str, Any]) -> None:
    """Print nested results as a table on the standard error."""
    _console().print(_rows(title, summary))


def _console(quiet: bool = False) -> Console:
    stream = cast(TextIO, _Lasting(sys.stderr)) if sys.stderr else None
    return Console(stderr=True, quiet=quiet, file=stream)


def _rows(title: str, summary: dict[str, Any]) -> Table:
    """A row for each entry that says something."""

    def short(value: Any) -> str:
        return f"{value:.4g}" if isinstance(value, float) else str(value)

    # Escaped, since an error may have text in brackets, which Rich would take for its markup.
    table = Table(title=escape(title), title_justify="left", show_header=False, box=None)
    for name, value in summary.items():
        if isinstance(value, dict):
            value = ", ".join(f"{k} {short(v)}" for k, v in value.items() if v)
        if value not in ("", []):
            table.add_row(name.replace("_", " "), escape(short(value)))
    return table


def hand_tables(hand: Hand, measured: HandMeasurement, target: np.ndarray | None, sent: bool) -> Table:
    """Joints on the left, with the error registers of their boards; fingertips on the right.

    `target` [J] rad are the newest joint targets, None before the first; `sent` tells whether the motors follow them.
    """
    heat, force = measured.temperature, measured.finger_force
    title = "target" if sent else "(not sent)"
    joints = _table("joint (rad)", "measured", title, "A", "degC", "errors: palm", "joint", "tip")
    for joint, name in enumerate(hand.joint_names):
        joints.add_row(
            f"{joint:2d} {name}",
            f"{measured.joint_position[joint]:.3f}",
            "-" if target is None else f"{target[joint]:.3f}",
            "-" if np.isnan(measured.current[joint]) else f"{measured.current[joint]:.2f}",
            f"{heat[joint]:.0f}",
            *(f"{bits:04x}" if bits else "-" for bits in measured.errors[joint]),
        )
    fingers = _table("finger", "N", "degC")
    for name, newtons, degrees in zip(hand.finger_names, force, heat[hand.num_joints :], strict=False):
        fingers.add_row(name, f"{newtons:.1f}", f"{degrees:.0f}")
    fingers.add_row("sum", f"{force.sum():.1f}", "")
    fingers.add_row("palm board", "", f"{heat[-1]:.0f}")
    both = Table.grid(padding=(0, 3))
    both.add_row(joints, fingers)
    return both


def _table(first: str, *others: str) -> Table:
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1), collapse_padding=True, pad_edge=False, show_edge=False)
    table.add_column(first, no_wrap=True)
    for name in others:
        table.add_column(name, justify="right", no_wrap=True)
    return table
