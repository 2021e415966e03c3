"""A scripted hand for runs of the bridge's commands, and what a run leaves behind."""

import json
import time

import numpy as np
from pty_hand import PtyHand

from dexsim_real.core.log import LogReader, LogWriter
from dexsim_real.wire.frames import Mode


class FollowingHand(PtyHand):
    """Joints that go a third of the way to their target at each exchange; it keeps what was asked of it."""

    def __init__(self, trouble=lambda index, state: None):
        super().__init__(self._follow)
        self.trouble = trouble
        self.times, self.poses = [], []
        self.state["joint"]["position"] = 0.1
        self.state["joint"]["position"][3] = 0.0

    def _follow(self, index, block, state):
        time.sleep(0)  # Lets the thread that waits for the answer go first.
        joint = state["joint"]
        self.times.append(time.monotonic())
        self.poses.append(joint["position"].copy())
        on = block["mode"] == Mode.POSITION
        joint["position"] += np.where(on, (block["position"] - joint["position"]) / 3, 0)
        return self.trouble(index, state)

    def on(self):
        """Whether the motors were on, by exchange."""
        return np.array([bool(np.all(block["mode"] == Mode.POSITION)) for block in self.commands])


def arguments(peer, folder, *more):
    """Patient with the peer, which shares this process and perhaps a busy machine."""
    options = "--uncalibrated --yes --fixed-object --link.settle 0 --link.no-paced --link.margin 0.2"
    options += " --safety.stale 1 --safety.watchdog 2 --approach 0.4 --quiet --no-realtime --no-guard"
    files = ["--log", str(folder / "run.log"), "--output", str(folder / "run.json")]
    return ["grasp", "--port", peer.port, *options.split(), *files, *more]


def summary(folder):
    return json.loads((folder / "run.json").read_text())


def records(folder, kind):
    return [record.content for record in LogReader(folder / "run.log") if record.kind == kind]


def rewritten(source, path, change):
    """A log with changed records; a change to None drops one."""
    with LogWriter(path) as log:
        for entry in LogReader(source):
            if (new := change(entry)) is not None:
                log.add(new.kind, new.content, new.time)
    return path
