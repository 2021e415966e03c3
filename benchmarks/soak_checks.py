"""Evaluation of the soak test: what logs, reports and counters say about faults and killed runners."""

from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from dexsim_real.core.log import Kind, LogError, LogReader
from dexsim_real.replay.replay import replay
from dexsim_real.wire import frames

EXPECTED = ("time is over",) + tuple(
    f"stopped: {why}"
    for why in ("too hot", "implausible", "error bits", "the hand switched itself off", "stalled", "the hand reports")
)
"""Ends of runs with faults."""


def inspect(path: Path, safe: float) -> dict:
    """Evaluate a log: counters at the end, and how soon each loss of the hand was noticed.

    Args:
      path: of the log.
      safe: s within which a loss must be noticed.
    """
    reader, link, end, state = LogReader(path), {}, "no end", None
    implausible = 0
    states, sent, notes = [], [], []
    for record in reader:
        if record.kind == Kind.RECEIVED and record.content[1][4] == frames.Command.EXCHANGE:
            states.append(record.time)
            state = record.content[1]
        elif record.kind == Kind.SENT and record.content[1][4] == frames.Command.EXCHANGE:
            if frames.decode_command(record.content[1][7:-2])["mode"][0] != frames.Mode.PASSIVE:
                sent.append(record.time)
        elif record.kind == Kind.NOTE and record.content.startswith(("clip", "hold", "relax", "in command")):
            notes.append((record.time, record.content.startswith(("hold: no measurement", "relax"))))
        elif record.kind == Kind.END:
            link, end = record.content["link"], record.content["end"]
            implausible = record.content["safety"].get("implausible: measurement", 0)

    def stuck(taxels: list) -> bool:
        seen = frames.decode_state(state[7:-2])["tip"]["taxel"]["z"]
        return all(seen[tip, taxel] == count for tip, taxel, count in taxels)

    return {
        "link": link,
        "end": end.split(":")[0] + (": " + end.split(":")[1].strip() if "stopped" in end else ""),
        "damaged": reader.damaged,
        "implausible": implausible,
        "holds": list(reactions(states, sent, notes, safe)),
        "stuck": stuck,
    }


def reactions(states: list[float], sent: list[float], notes: list[tuple[float, bool]], safe: float) -> Iterator[float]:
    """For each silence longer than allowed, the age in s of the last state at the last command before the hold.

    `notes` are the changes of the bridge's reaction: their time, and whether it then held or relaxed for lack of
    measurements. A bridge that the machine has suspended sends nothing, which is safe.
    """
    for before, after in zip(states, states[1:], strict=False):
        if after - before <= safe or not sent or not sent[0] <= before <= sent[-1]:
            continue
        later = [(when, holds) for when, holds in notes if before < when <= after]
        held = [holds for when, holds in notes if when <= before][-1:] == [True] and not later
        alarm = before if held else min((when for when, holds in later if holds), default=after)
        yield max((when - before for when in sent if before < when < alarm), default=0.0)


ALLOWED = {"heat": 0.0, "warm": 0.0, "error": 0.2, "off": 0.2, "jam": 3.0, "refuse": 0.0, "refuse: number 6": 1.05}
"""Seconds for which the bridge may tolerate an alarm, by its kind; a hand that is busy is only silent."""
_DISTURBED = tuple(f"fault {kind}:" for kind in ("stall", "late", "disconnect", "angle"))


def alarm_reactions(report: dict) -> list[tuple[str, float]]:
    """For alarms of a hand whose motors are on: kind, and s from the allowed time until the motors were off.

    An alarm is left out if another fault kept the bridge from seeing it, up to a second before or until the motors were
    off.
    """
    on, pending, disturbed, found = False, [], -1e9, []
    for when, text in report["events"]:
        if text.startswith(_DISTURBED):
            disturbed, pending = when, []
        elif text == "motors on":
            on = True
        elif text.startswith(("motors off", "watchdog")):
            found += [(kind, when - begun - ALLOWED[kind]) for kind, begun in pending]
            on, pending = False, []
        elif text.startswith("fault ") and on and when > disturbed + 1.0:
            kind = max((kind for kind in ALLOWED if text.startswith(f"fault {kind}")), key=len)
            pending.append((kind, when))
    return found


def agreement(host: Counter, report: dict) -> dict[str, tuple[int, int]]:
    """Pairs of the host's counters and the injected faults, by name."""
    line, made, expected = Counter(report["line"]), Counter(report["faults"]["injected"]), report["faults"]["expected"]
    damaged_requests = sum(made[f"{kind} request"] for kind in ("flip", "drop", "duplicate"))
    return {
        "corrupt": (host["corrupt"], expected["corrupt"]),
        "lost": (host["lost"], expected["lost"]),
        # Requests without an answer, and late answers.
        "silent": (host["silent"], damaged_requests + line["ignored"] + host["late"]),
        "answered": (host["answered"] + host["refused"] + host["late"], line["answers"]),
        "sent": (host["sent"], line["requests"]),
        "every request counted once": (
            host["sent"],
            sum(host[k] for k in ("answered", "corrupt", "silent", "refused", "lost")),
        ),
    }


def autopsy(path: Path, death: float) -> dict:
    """The log of a killed runner: whether it opens and replays, and seconds from its last record to the kill."""
    try:
        reader = LogReader(path)
        records = list(reader)
    except LogError:
        return {"opened": False, "same": False, "lost": float("inf"), "damaged": 0, "ticks": 0}
    row = {
        "opened": True,
        "same": True,
        "damaged": reader.damaged,
        "ticks": 0,
        # Exchanges are recorded from the handshake on; before that nothing can be lost.
        "lost": death - records[-1].time if any(record.kind == Kind.RECEIVED for record in records) else 0.0,
    }
    if any(record.kind == Kind.META for record in records):
        again = replay(path).report
        row |= {"ticks": again["ticks"], "same": again["observations_same"] == again["readings_same"] == again["ticks"]}
    return row


def on_at_end(report: dict) -> bool:
    """Whether the last event that concerns the motors turned them on."""
    changes = [text for _, text in report["events"] if text.startswith(("motors", "watchdog"))]
    return changes[-1:] == ["motors on"]


def motors_off(report: dict, death: float, until: float) -> float | None:
    """Seconds from a kill until the motors were off; None if they were off already, infinity if not by `until`.

    A request on the wire at the time of the kill may still turn them on.
    """
    on = False
    for when, text in report["events"]:
        if when >= until:
            break
        if text == "motors on":
            on = True
        elif text.startswith(("motors off", "watchdog")):
            if on and when >= death:
                return when - death
            on = False
    return float("inf") if on else None
