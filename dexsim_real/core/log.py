"""Run logs: append-only records, written by a background thread, readable after any crash.

    DXSLOG2\\n, then records: sync (4 bytes) | length | CRC-32 | msgpack of [kind, time, content]

A record reaches the kernel within 0.1 s and then survives the end of the program. Once a second the file is synced to
the disk. A truncated or damaged record costs only itself.
"""

import contextlib
import dataclasses
import enum
import os
import queue
import struct
import threading
import time
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgpack
import numpy as np

from dexsim.errors import DexsimError
from dexsim_real.core.process import BACKGROUND, change_priority

MAGIC = b"DXSLOG2\n"
SYNC = b"\xd5\x0c\xa7\x1e"
_HEAD = struct.Struct("<4sII")
_WAIT = 0.05  # s between two writes
_FORCE = 1.0  # s between two syncs to the disk
_MAX_QUEUED = 50_000  # records waiting for a slow disk
_LONGEST = 1 << 22  # bytes of a payload; the longest, of a run's configuration, has some ten thousand


class LogError(DexsimError):
    """A log cannot be written, or a file is not a log."""


class Kind(enum.IntEnum):
    META = 1  # configuration of the run
    SENT = 2  # (number of the exchange, frame) from the host
    RECEIVED = 3  # the same from the hand
    TICK = 4  # readings, observation, action and joint target of one control tick
    NOTE = 5  # one line of text
    END = 6  # summary


@dataclasses.dataclass(frozen=True)
class Record:
    """One entry of a log."""

    kind: Kind
    time: float  # s, monotonic clock of the machine that wrote it
    content: Any  # dict with NumPy arrays, text, or (number, frame), by `kind`


class LogWriter(contextlib.AbstractContextManager):
    """Accepts records from any thread without blocking. A context manager.

    A full disk ends the log, not the run: `failure` has the reason and `dropped` counts the lost records.

    Raises LogError: the file cannot be created, or exists.
    """

    def __init__(self, path: str | Path):
        self.path = Path(path)
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._file = os.open(self.path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND, 0o644)
            os.write(self._file, MAGIC)
        except OSError as error:
            raise LogError(f"{self.path}: the log cannot be written ({error.strerror}); choose another --log") from None
        self.failure = ""
        self.dropped = 0
        self._queue: queue.SimpleQueue = queue.SimpleQueue()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="log", daemon=True)
        self._thread.start()

    @property
    def losses(self) -> str:
        """One line about lost records; empty if there are none."""
        if not (self.dropped or self.failure):
            return ""
        return f"{self.dropped} log records are lost ({self.failure or 'the disk is too slow'})"

    def __exit__(self, *_: object) -> None:
        self.close()

    def add(self, kind: Kind, content: Any, when: float | None = None) -> None:
        """Queue a record of the time `when` in s, by default now. Its arrays must not change afterwards."""
        if self.failure or self._queue.qsize() > _MAX_QUEUED:
            self.dropped += 1
            return
        self._queue.put((kind, time.monotonic() if when is None else when, content))

    def close(self) -> None:
        """Write all queued records and close the file."""
        if not self._stop.is_set():
            self._stop.set()
            self._thread.join()
            os.close(self._file)

    def _run(self) -> None:
        change_priority(BACKGROUND)
        synced = time.monotonic()
        while True:
            last = self._stop.wait(_WAIT)
            batch = []
            while not self._queue.empty():
                kind, when, content = self._queue.get()
                try:
                    batch.append(encode(kind, when, content))
                except Exception as error:  # It must not end the thread.
                    self.failure = f"{self.path}: a {kind.name} record cannot be written ({error})"
                    self.dropped += 1
                time.sleep(0)  # Releases the interpreter lock to a waiting thread.
            try:
                data = memoryview(b"".join(batch))
                while data:
                    data = data[os.write(self._file, data) :]
                if last or time.monotonic() - synced > _FORCE:
                    os.fdatasync(self._file)
                    synced = time.monotonic()
            except OSError as error:
                self.failure = f"{self.path}: {error.strerror}"
                self.dropped += len(batch)
            if last:
                return


def encode(kind: Kind, when: float, content: Any) -> bytes:
    payload = msgpack.packb([int(kind), when, content], default=_pack_array)
    return _HEAD.pack(SYNC, len(payload), zlib.crc32(payload)) + payload


class LogReader:
    """Iterates over the intact records of a log; `damaged` counts the other bytes, at the end.

    Raises LogError: the file is missing or is not a log.
    """

    def __init__(self, path: str | Path):
        self.path, self.damaged = Path(path), 0
        try:
            self._data = self.path.read_bytes()
        except OSError as error:
            raise LogError(f"{self.path}: the log cannot be read ({error.strerror})") from None
        if not self._data.startswith(MAGIC):
            raise LogError(f"{self.path}: this is not a log of `dexsim_real`; give a .log file of a run")

    def __iter__(self) -> Iterator[Record]:
        data, at = self._data, len(MAGIC)
        self.damaged = len(data) - at
        while (at := data.find(SYNC, at)) >= 0 and at + _HEAD.size <= len(data):
            _, size, checksum = _HEAD.unpack_from(data, at)
            end = at + _HEAD.size + size
            payload = data[end - size : end] if size <= _LONGEST else b""
            if not payload or len(payload) < size or zlib.crc32(payload) != checksum:
                at += 1  # An intact record may begin within a damaged one.
                continue
            self.damaged -= end - at
            at = end
            kind, when, content = msgpack.unpackb(payload, object_hook=_unpack_array, strict_map_key=False)
            yield Record(Kind(kind), when, content)


@contextlib.contextmanager
def reading(path: str | Path) -> Iterator[None]:
    """Turn the error of a reader about a record of unexpected content into one line.

    Raises LogError: there is such a record.
    """
    try:
        yield
    except DexsimError:
        raise
    except Exception as error:
        raise LogError(f"{path}: invalid record ({type(error).__name__}: {error}); record again") from error


def _pack_array(value: Any) -> Any:
    array = np.asarray(value)
    return {"__array__": array.dtype.str, "shape": list(array.shape), "data": array.tobytes()}


def _unpack_array(value: dict) -> Any:
    if "__array__" not in value:
        return value
    return np.frombuffer(value["data"], value["__array__"]).reshape(value["shape"])
