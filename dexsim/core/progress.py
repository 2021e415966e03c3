"""A bar on the terminal for work that takes long; now and then a line where there is no terminal."""

import contextlib
import time
from collections.abc import Callable, Iterator

_QUIET = 10.0  # s between two lines without a terminal


@contextlib.contextmanager
def progress(label: str, total: int, unit: str) -> Iterator[Callable[[int], None]]:
    """Show how much of `total` is done, on standard error; yields a function that takes what is done so far."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    console = Console(stderr=True)
    if not console.is_terminal:
        yield _lines(label, total, unit, console.print)
        return
    columns = (
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(None),
        TextColumn("{task.completed:.0f} of {task.total:.0f} {task.fields[unit]}"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console, transient=True, expand=True) as bar:
        task = bar.add_task(label, total=total, unit=unit)
        yield lambda done: bar.update(task, completed=done)


def _lines(label: str, total: int, unit: str, show: Callable[..., None]) -> Callable[[int], None]:
    began = last = time.monotonic()

    def update(done: int) -> None:
        nonlocal last
        now = time.monotonic()
        if done < total and now > last + _QUIET:
            last = now
            show(f"{label}: {done} of {total} {unit}, {now - began:.0f} s", highlight=False)

    return update
