"""Virtual time for a run on a hand, whose two threads take turns: nothing depends on how busy the machine is."""

import functools
import itertools
import threading
import time
from types import SimpleNamespace

from pty_hand import MemoryLine, PtyHand

from dexsim_real import loop


class VirtualTime:
    """In place of the module `time`. One thread runs at a time; when it sleeps, the one that is due first is next."""

    def __init__(self):
        self.now, self._due, self._turn, self._number = 1000.0, [], threading.Condition(), itertools.count()

    def __getattr__(self, name):
        return getattr(time, name)

    def monotonic(self):
        return self.now

    def sleep(self, seconds):
        due = self.queue(seconds)
        self.pass_on()
        self.await_turn(due)

    def queue(self, seconds):
        """The place of a thread that runs again after so many seconds."""
        due = self.now + seconds, next(self._number)
        self._due.append(due)
        return due

    def await_turn(self, due):
        with self._turn:
            self._turn.wait_for(lambda: due not in self._due)

    def pass_on(self):
        """The running thread ends or waits: the next one runs."""
        with self._turn:
            if self._due:
                self._due.remove(due := min(self._due))
                self.now = max(self.now, due[0])
                self._turn.notify_all()

    def install(self, monkeypatch):
        """For runs, the ROS node and mocks; a `PtyHand` is connected in memory."""
        here, peers = {"clock": self.monotonic, "sleep": self.sleep}, {}
        open_line = PtyHand.open

        def open_hand(peer):
            open_line(peer)
            peers[peer.port], peer.delay = peer, 0.002

        monkeypatch.setattr(PtyHand, "open", open_hand)
        monkeypatch.setattr("serial.serial_for_url", lambda url, timeout, **_: MemoryLine(peers[url], timeout, self))
        for module in ("dexsim_real.run", "dexsim_real.wire.link", "dexsim_real.twin.mock", "following_hand"):
            monkeypatch.setattr(f"{module}.time", self)
        monkeypatch.setattr("dexsim_real.core.log.time", SimpleNamespace(monotonic=self.monotonic, sleep=time.sleep))
        monkeypatch.setattr("dexsim_real.run.Pace", functools.partial(loop.Pace, **here))
        for module in ("run", "ros"):
            made = functools.partial(_Loop, time=self, **here)
            monkeypatch.setattr(f"dexsim_real.{module}.LoopThread", made)


class _Loop(loop.LoopThread):
    def __init__(self, *parts, time, **options):
        super().__init__(*parts, **options)
        self._time = time

    def start(self):
        self._first = self._time.queue(0.0)
        super().start()

    def stop(self):
        if self._thread.is_alive():
            self._time.pass_on()
        super().stop()

    def _run(self):
        self._time.await_turn(self._first)
        try:
            super()._run()
        finally:
            self._time.pass_on()
