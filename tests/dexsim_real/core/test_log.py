"""The log: what goes in comes out, whatever happens to the program or to the file."""

import errno
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from hypothesis import given, strategies as st
from paths import ROOT

from dexsim_real.core.log import MAGIC, SYNC, Kind, LogError, LogReader, LogWriter, encode


def test_what_goes_in_comes_out_in_order(tmp_path):
    rng, path = np.random.default_rng(0), tmp_path / "deep" / "run.log"
    sent = []
    for k in range(100):
        tick = {"force": rng.normal(size=(5, 120)).astype(np.float32), "command": np.float32(0.5), "sequence": k}
        sent += [(Kind.RECEIVED, (k, rng.bytes(k))), (Kind.NOTE, f"line {k} with ä"), (Kind.TICK, tick)]
    with LogWriter(path) as writer:
        for at, (kind, content) in enumerate(sent):
            writer.add(kind, content, when=float(at))
    for at, (record, (kind, content)) in enumerate(zip(LogReader(path), sent, strict=True)):
        assert (record.kind, record.time) == (kind, float(at))
        if kind == Kind.TICK:
            for name, value in content.items():
                np.testing.assert_array_equal(record.content[name], value, strict=name != "sequence")
        else:
            assert list(record.content) == list(content)


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    path = tmp_path_factory.mktemp("log") / "run.log"
    with LogWriter(path) as writer:
        for i in range(20):
            writer.add(Kind.NOTE, f"note {i}", when=float(i))
    return path.read_bytes()


@given(st.integers(0, 999), st.integers(1, 255))
def test_a_cut_or_damage_anywhere_costs_the_records_that_it_hits(small, tmp_path_factory, place, bits):
    at, path = len(MAGIC) + (len(small) - len(MAGIC)) * place // 1000, tmp_path_factory.mktemp("bad") / "run.log"
    whole, size = [f"note {i}" for i in range(20)], len(encode(Kind.NOTE, 0.0, "note 0"))
    path.write_bytes(small[:at])
    got = [record.content for record in LogReader(path)]
    # The first ten records are of one size.
    assert got == whole[: len(got)] and len(got) >= min((at - len(MAGIC)) // size, 10)
    path.write_bytes(small[:at] + bytes([small[at] ^ bits]) + small[at + 1 :] + SYNC + bytes(bits))  # and blocks of 0
    reader = LogReader(path)
    got = [record.content for record in reader]
    assert len(got) == 19 and set(got) < set(whole) and reader.damaged > 0


def test_files_that_are_no_log(tmp_path):
    with pytest.raises(LogError, match="cannot be read"):
        LogReader(tmp_path / "none")
    (tmp_path / "text").write_text("hello")
    with pytest.raises(LogError, match="not a log"):
        LogReader(tmp_path / "text")
    (tmp_path / "file").touch()
    with pytest.raises(LogError, match="cannot be written"):
        LogWriter(tmp_path / "file")  # A log is never overwritten.


def test_a_record_that_cannot_be_written_is_counted_and_costs_no_other(tmp_path):
    """Not the thread that writes them."""
    with LogWriter(tmp_path / "run.log") as writer:
        writer.add(Kind.NOTE, "before")
        writer.add(Kind.NOTE, "a name that is no text: \udcff")
        writer.add(Kind.NOTE, "with it")
    assert "a NOTE record cannot be written" in writer.failure and writer.dropped == 1
    assert [record.content for record in LogReader(writer.path)] == ["before", "with it"]


def test_a_full_disk_ends_the_log_and_nothing_else(tmp_path, monkeypatch):
    def full(file, data):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with LogWriter(tmp_path / "run.log") as writer:
        monkeypatch.setattr(os, "write", full)
        writer.add(Kind.NOTE, "lost")
    assert writer.losses == f"1 log records are lost ({writer.path}: No space left on device)"


def test_killed_at_any_moment_all_but_the_last_moment_is_there(tmp_path):
    """SIGKILL, again and again: every log opens, and what had reached the kernel is there, whole and in order."""
    code = """
import sys, time
from dexsim_real.core.log import Kind, LogWriter
log = LogWriter(sys.argv[1])
print("ready", flush=True)
while True:
    log.add(Kind.NOTE, repr(time.monotonic()))
    log.add(Kind.RECEIVED, (1, bytes(2217)))
    time.sleep(0.005)
"""
    rng = np.random.default_rng(5)
    started = []
    for i in range(4):
        path = tmp_path / f"{i}.log"
        process = subprocess.Popen([sys.executable, "-c", code, str(path)], cwd=ROOT, stdout=subprocess.PIPE)
        started.append((path, process))
    for path, process in started:
        assert process.stdout.readline() == b"ready\n"
        written = int(rng.integers(20_000, 100_000))  # bytes; a writer that waited for the end would have none
        while path.stat().st_size < written:
            time.sleep(0.005)
        process.send_signal(signal.SIGKILL)
        process.wait()
        notes = [float(record.content) for record in LogReader(path) if record.kind == Kind.NOTE]
        assert notes == sorted(notes) and len(notes) >= written // 2300
