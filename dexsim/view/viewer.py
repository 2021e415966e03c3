"""The page: scene, read-outs and controls, kept in step with a source, which also says what of it can be changed."""

import contextlib
import dataclasses
import io
import socket
import time
from collections.abc import Callable, Iterator
from typing import Any, Protocol

import numpy as np

from dexsim.errors import DexsimError
from dexsim.hand.description import Hand
from dexsim.render.panel import draw_panel, read_outs
from dexsim.view.scene import Frame, Scene

_PANEL = (300, 560)  # pixels of the taxel maps
_READ_OUT = 0.2  # s between two updates of text and maps: they cost more than the scene
_FADE = 3.0  # s, in which the scales of force fall to 1/e


class Source(Protocol):
    """Where frames come from. All calls come from one thread."""

    hand: Hand
    period: float
    """Time from one frame to the next, s."""
    task: str
    """Of whose preset camera the page opens with (`dexsim.render.render.camera_of`)."""

    def add_controls(self, gui: Any) -> None:
        """Put what can be changed on the page, before anything else is asked for: `gui` is viser's."""

    def episode(self) -> Iterator[Frame]:
        """The frames of a new episode, to its end."""


def frames_of(source: Source) -> Iterator[Frame]:
    """Of one episode after another."""
    while True:
        yield from source.episode()


def clicked(button: Any) -> bool:
    """Whether a button of viser was clicked since this was last asked."""
    was, button.value = button.value, False
    return was


class Viewer:
    """A source in the browser, on a page that is served at a host and port. Raises DexsimError: `host` is no address of
    this computer."""

    def __init__(self, source: Source, *, title: str, host: str = "127.0.0.1", port: int = 8080):
        import viser

        self.source = source
        try:  # viser would wait forever
            socket.create_server((host, 0)).close()
        except OSError as error:
            raise DexsimError(f"host {host!r:.100}: no page can be served there ({error.strerror or error})") from None
        with contextlib.redirect_stdout(io.StringIO()):  # Its box names the address in its own words.
            self.server = viser.ViserServer(host=host, port=port, label=title, verbose=False)
        self.server.gui.configure_theme(dark_mode=True, show_share_button=False, control_width="large")
        self.scene = Scene(self.server, source.hand, source.task)
        # The scales follow the largest taxel and finger force of the last seconds.
        self._taxel_range, self._finger_range, self._read_out_at = 0.05, 1.0, 0.0
        gui = self.server.gui
        self._text = gui.add_markdown("")
        with gui.add_folder("Playback"):
            self.paused = gui.add_checkbox("paused", False)
            self._step, self._reset = gui.add_button("step"), gui.add_button("reset")
        with gui.add_folder("Controls"):
            source.add_controls(gui)
        with gui.add_folder("Touch"):
            self._maps = gui.add_image(np.zeros((_PANEL[1], _PANEL[0], 3), np.uint8))

    @property
    def url(self) -> str:
        """Where the page is."""
        return f"http://{self.server.get_host()}:{self.server.get_port()}"

    def run(self, stopped: Callable[[], bool] = lambda: False) -> None:
        """Show the source in real time until `stopped`; returns with the server down."""
        try:
            frames, due = frames_of(self.source), time.monotonic()
            frame = next(frames)
            while not stopped():
                if reset := clicked(self._reset):
                    frames = frames_of(self.source)
                if reset or not self.paused.value or clicked(self._step):
                    frame = next(frames)
                self._show(frame)
                due = max(due + self.source.period, time.monotonic() - self.source.period)
                time.sleep(max(due - time.monotonic(), 0.001))
        finally:
            with contextlib.redirect_stdout(io.StringIO()):
                self.server.stop()

    def _show(self, frame: Frame) -> None:
        # On a hand nothing measures the true force: every source shows what the taxels feel.
        total = np.asarray(frame.snapshot.taxel_force).sum(-1)
        snapshot = dataclasses.replace(frame.snapshot, finger_force=total)
        fade = np.exp(-self.source.period / _FADE)
        self._taxel_range = max(0.05, fade * self._taxel_range, float(np.max(snapshot.taxel_force)))
        self._finger_range = max(1.0, fade * self._finger_range, float(np.max(total)))
        self.scene.show(frame, self._taxel_range)
        if time.monotonic() < self._read_out_at + _READ_OUT:
            return
        self._read_out_at = time.monotonic()
        words = read_outs(snapshot) | ({"state": frame.note} if frame.note else {})
        if frame.command is not None:
            words["command"] = f"{frame.command:.2f}, with the force loop {words['command']}"
        self._text.content = "  \n".join(f"{name}: **{word}**" for name, word in words.items())
        ranges = self._taxel_range, self._finger_range
        self._maps.image = draw_panel(self.source.hand, _PANEL, snapshot, *ranges, live=True)
