"""A bar on the terminal for work that takes long; now and then a line where there is no terminal."""

import contextlib
import time
from collections.abc import Callable, Iterator

_QUIET = 10.0  # s between two lines without a terminal


@contextlib.contextmanager
def progress(label: str, total: int, unit: str) -> Iterator[Callable[[int], None]]:
    """Show how much of `total` is done, on standard error; yields a function that takes what is done so far."""
    from rich.console import Console
    from rich.progress import Progress

    console = Console(stderr=True)
    started = last = time.monotonic()

    def print_line(done: int) -> None:
        nonlocal last
        now = time.monotonic()
        if done < total and now > last + _QUIET:
            last = now
            console.print(f"{label}: {done} of {total} {unit}, {now - started:.0f} s", highlight=False)

    if not console.is_terminal:
        yield print_line
        return
    with Progress(console=console, transient=True) as bar:
        task = bar.add_task(f"{label} ({total} {unit})", total=total)
        yield lambda done: bar.update(task, completed=done)
