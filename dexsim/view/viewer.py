"""The page: scene, read-outs and controls, kept in step with a source."""

import contextlib
import dataclasses
import io
import socket
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from dexsim.core.errors import DexsimError
from dexsim.render.panel import FELT, Panel, read_outs
from dexsim.view.scene import Scene
from dexsim.view.source import Choice, Control, Frame, Slider, Source

_PANEL = (300, 560)  # pixels of the taxel maps
_READ_OUT = 0.2  # s between two updates of text and maps: they cost more than the scene
_FADE = 3.0  # s, in which the scales of force fall to 1/e
_CHOICES = 3.0  # s between two looks for new choices


class Viewer:
    """A source in the browser, on a page that is served at a host and port.

    Raises:
      DexsimError: `host` is no address of this computer.
    """

    def __init__(self, source: Source, *, title: str, host: str = "127.0.0.1", port: int = 8080):
        import viser

        self.source, hand = source, source.hand
        try:  # viser would wait forever
            socket.create_server((host, 0)).close()
        except OSError as error:
            raise DexsimError(f"host {host!r:.100}: no page can be served there ({error.strerror or error})") from None
        with contextlib.redirect_stdout(io.StringIO()):  # Its box names the address in its own words.
            self.server = viser.ViserServer(host=host, port=port, label=title, verbose=False)
        self.server.gui.configure_theme(dark_mode=True, show_share_button=False, control_width="large")
        self.scene = Scene(self.server, hand, source.task)
        self._panel = Panel(hand, *_PANEL)
        self._clicked: set[str] = set()
        self._handles: dict[str, Any] = {}
        self._controls: dict[str, Control] = {}
        # The scales follow the largest taxel and finger force of the last seconds.
        self._taxel_range, self._finger_range, self._read_out_at, self._looked_at = 0.05, 1.0, 0.0, 0.0
        gui = self.server.gui
        self._text = gui.add_markdown("")
        with gui.add_folder("Playback"):
            self.paused = gui.add_checkbox("paused", False)
            for name in ("step", "reset"):
                self._button(name)
        self._folder = gui.add_folder("Controls")
        self._refresh()
        with gui.add_folder("Touch"):
            self._maps = gui.add_image(np.zeros((_PANEL[1], _PANEL[0], 3), np.uint8))

    @property
    def url(self) -> str:
        """Where the page is."""
        return f"http://{self.server.get_host()}:{self.server.get_port()}"

    def run(self, stopped: Callable[[], bool] = lambda: False) -> None:
        """Show the source in real time until `stopped`; returns with the server down."""
        try:
            frame, due = self.source.reset(self.values()), time.monotonic()
            while not stopped():
                self._refresh()
                if self._take("reset"):
                    frame = self.source.reset(self.values())
                elif not self.paused.value or self._take("step"):
                    frame = self.source.step(self.values())
                self._show(frame)
                due = max(due + self.source.period, time.monotonic() - self.source.period)
                time.sleep(max(due - time.monotonic(), 0.001))
        finally:
            with contextlib.redirect_stdout(io.StringIO()):
                self.server.stop()

    def values(self) -> dict[str, Any]:
        """What the page's controls are set to; a click on a button counts once."""
        taken = {name: self._take(name) for name in self._controls if name not in self._handles}
        return {name: handle.value for name, handle in self._handles.items()} | taken

    def _take(self, name: str) -> bool:
        clicked = name in self._clicked
        self._clicked.discard(name)
        return clicked

    def _button(self, name: str) -> None:
        self.server.gui.add_button(name).on_click(lambda _: self._clicked.add(name))

    def _refresh(self) -> None:
        """Add the source's controls; later on keep its choices up to date."""
        if time.monotonic() < self._looked_at + _CHOICES:
            return
        self._looked_at, gui = time.monotonic(), self.server.gui
        for name, control in self.source.controls().items():
            if name not in self._controls:
                with self._folder:
                    if isinstance(control, Slider):
                        self._handles[name] = gui.add_slider(
                            name, min=control.low, max=control.high, step=control.step, initial_value=control.value
                        )
                    elif isinstance(control, Choice):
                        self._handles[name] = gui.add_dropdown(name, control.options)
                    else:
                        self._button(name)
            elif isinstance(control, Choice) and control != self._controls[name]:
                self._handles[name].options = control.options
            self._controls[name] = control

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
        if "command" in self._handles and "command" in words:  # The force loop adds to what the user has set.
            words["command"] = f"{self._handles['command'].value:.2f}, with the force loop {words['command']}"
        self._text.content = "  \n".join(f"{name}: **{word}**" for name, word in words.items())
        self._maps.image = self._panel.draw(snapshot, self._taxel_range, self._finger_range, {}, FELT)
