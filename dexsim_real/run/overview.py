"""The state of a run in words."""

import time
from typing import TYPE_CHECKING

from dexsim_real.control.safety import Reaction
from dexsim_real.core.timing import Timing
from dexsim_real.run.hand_view import HandState
from dexsim_real.run.status import Status

if TYPE_CHECKING:
    from dexsim_real.run.session import Session


def overview(session: "Session") -> Status:
    """What the view shows of a run; called from its thread."""
    safety, servo, counts, tick = session.safety, session.servo, session.port.counts, session.tick
    sample = safety.sample
    if sample is None:
        return Status({"hand": safety.problem or "no measurement"})
    reaction, reason = safety.last
    now, trip = time.monotonic(), servo.round_trip
    rows = {
        "time": f"{now - session.started if session.started else 0:.1f} s",
        "safety": f"{reaction.name.lower()} {reason}".strip(),
        "age": f"{1e3 * (now - sample.time):.1f} ms {safety.problem}".strip(),
        "policy": _timing(session.pace.jitter, 1 / session.pace.period),
        "exchanges": _timing(servo.pace.jitter, 1 / servo.pace.period),
        "round trip": f"p50 {1e3 * trip.percentile(50):.2f} ms, p99 {1e3 * trip.percentile(99):.2f} ms",
        "link": f"{counts.answered} answered, {counts.corrupt} corrupt, {counts.silent} silent, "
        f"{counts.late} late, {counts.reconnects} reconnects",
        "command": f"{session.arguments.command:.2f}",
    }
    if session.goals:
        rows["successes"] = str(session.goals.successes)
    sent = reaction != Reaction.RELAX
    target = safety.commanded if sent else tick.target if tick else None
    return Status(rows, HandState(session.sensing.hand, sample.measured, target, sent))


def _timing(timing: Timing, rate: float) -> str:
    if not timing.count:
        return f"{rate:.1f} Hz"
    return (
        f"{rate:.1f} Hz, late p50 {1e3 * timing.percentile(50):.2f} ms, "
        f"p99 {1e3 * timing.percentile(99):.2f} ms, missed {timing.missed}"
    )
