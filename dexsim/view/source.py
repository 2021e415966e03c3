"""What a view shows: frames from a source, and what of it can be changed."""

from collections.abc import Mapping
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


class Slider(NamedTuple):
    """A number that the page can set."""

    low: float
    high: float
    step: float
    value: float


class Choice(NamedTuple):
    """One of some names that the page can set."""

    options: tuple[str, ...]


class Button(NamedTuple):
    """Something that the page can ask for; its value is True in the one step after a click."""


Control = Slider | Choice | Button
Values = Mapping[str, Any]
"""The page's settings, by the names of the controls."""


class Source(Protocol):
    """Where frames come from. All calls come from one thread."""

    hand: Hand
    period: float
    """Time from one frame to the next, s."""
    task: str
    """Of whose preset camera the page opens with (`dexsim.render.render.camera_of`)."""

    def controls(self) -> dict[str, Control]:
        """What can be changed now, by name. Asked again while the view runs: options may come and go."""
        ...

    def reset(self, values: Values) -> Frame:
        """Begin anew."""
        ...

    def step(self, values: Values) -> Frame:
        """The next frame; begins anew by itself after an end."""
        ...
