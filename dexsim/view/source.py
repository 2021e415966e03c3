"""What a view shows: frames from a source, which also says what of it can be changed."""

from collections.abc import Iterator
from typing import Any, NamedTuple, Protocol

from dexsim.hand.description import Hand
from dexsim.render.snapshot import Snapshot


class Frame(NamedTuple):
    """One moment; NumPy."""

    snapshot: Snapshot
    kinds: tuple[str, ...]
    """Kinds of the object's primitives [K]; empty where the shape is not known."""
    note: str = ""
    """What happened, such as "dropped"."""
    command: float | None = None
    """The command that the page asks for, to which a force loop adds."""


class Source(Protocol):
    """Where frames come from. All calls come from one thread."""

    hand: Hand
    period: float
    """Time from one frame to the next, s."""
    task: str
    """Of whose preset camera the page opens with (`dexsim.render.render.camera_of`)."""

    def add_controls(self, gui: Any) -> None:
        """Put what can be changed on the page, before anything else is asked for: `gui` is viser's."""
        ...

    def episode(self) -> Iterator[Frame]:
        """The frames of a new episode, to its end."""
        ...


def frames_of(source: Source) -> Iterator[Frame]:
    """Of one episode after another."""
    while True:
        yield from source.episode()


def clicked(button: Any) -> bool:
    """Whether a button of viser was clicked since this was last asked."""
    was, button.value = button.value, False
    return was
