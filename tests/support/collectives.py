"""What a compiled program communicates, from its text in XLA's HLO."""

import collections
import math
import re

_BITS = {"pred": 8, "s4": 4, "u4": 4, "bf16": 16, "f16": 16}
# Bytes that a device of N receives with ring algorithms, over the bytes of the result.
_RING = {
    "all-reduce": lambda n: 2 * (n - 1) / n,
    "all-gather": lambda n: (n - 1) / n,
    "all-to-all": lambda n: (n - 1) / n,
    "reduce-scatter": lambda n: n - 1,
    "collective-permute": lambda n: 1,
    "collective-broadcast": lambda n: 1,
}
_SHAPE = re.compile(r"\b([a-z]+\d*)\[([\d,]*)\]")
_CALLS = re.compile(r"(?:body|condition|calls|to_apply|true_computation|false_computation)=%?([\w.\-]+)")
_HEAD = re.compile(r"^(ENTRY )?%?([\w.\-]+) \(.*\{\s*$")
_OP = re.compile(r"= (.*?) (" + "|".join(_RING) + r")(-start)?\(")


def received(text: str) -> tuple[float, dict[str, int]]:
    """Bytes that each device receives in one run of a program, and the number of its collectives by kind."""
    found, entry = _computations(text)
    partitions = int(match[1]) if (match := re.search(r"num_partitions=(\d+)", text)) else 1
    counts: collections.Counter[str] = collections.Counter()

    def visit(name: str, times: int) -> float:
        total = 0.0
        for line in found[name]:
            trips = _trips(line) if " while(" in line else 1
            if match := _OP.search(line):
                shapes, kind, started = match.groups()
                sizes = [_bytes(*each) for each in _SHAPE.findall(shapes)]
                if started and kind == "collective-permute":  # (operand, result, contexts)
                    sizes = sizes[1:2]
                elif started and kind != "all-reduce":  # (operands, results)
                    sizes = sizes[len(sizes) // 2 :]
                counts[kind] += times
                total += times * sum(sizes) * _RING[kind](_group(line, partitions))
                continue
            for called in _CALLS.findall(line):
                if called in found:
                    total += visit(called, times * trips)
        return total

    return visit(entry, 1), dict(counts)


def _computations(text: str) -> tuple[dict[str, list[str]], str]:
    """The lines of each computation, and the name of the first to run."""
    found: dict[str, list[str]] = {}
    entry, lines = "", []
    for line in text.splitlines():
        if match := _HEAD.match(line):
            lines = found.setdefault(match[2], [])
            entry = match[2] if match[1] else entry
        else:
            lines.append(line)
    return found, entry


def _trips(line: str) -> int:
    match = re.search(r'known_trip_count"?:\{"n":"(\d+)"', line)
    if not match:
        return 1
    return int(match[1])


def _group(line: str, partitions: int) -> int:
    """Devices that take part together."""
    if match := re.search(r"replica_groups=\[(\d+),(\d+)\]", line):
        return int(match[2])
    match = re.search(r"replica_groups=\{\{([\d,]*)\}", line)
    return len(match[1].split(",")) if match and match[1] else partitions


def _bytes(kind: str, dimensions: str) -> float:
    bits = _BITS.get(kind) or int(re.sub(r"\D", "", kind) or 0)
    return bits / 8 * math.prod(int(n) for n in dimensions.split(",") if n)
