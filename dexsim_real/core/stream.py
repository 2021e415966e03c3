"""Frames in a stream of bytes that may be damaged: of the hand's wire, of Dynamixel motors, of the IMU."""

from collections.abc import Callable
from typing import Generic, TypeVar

T = TypeVar("T")


class FrameParser(Generic[T]):
    """Extracts frames from a damaged or truncated stream; memory is bounded by one frame and one chunk.

    Where a frame cannot be decoded the search continues one byte after its head, so every intact frame of the stream is
    found. `frames` and `damaged` count them; `pending` has the bytes of an incomplete one.

    Args:
      head: bytes with which each frame begins.
      header: bytes that tell its size, `size(header)`; 0 where they begin no frame.
      decode: content of a whole frame; None for a damaged one.
    """

    def __init__(self, head: bytes, header: int, size: Callable[[bytes], int], decode: Callable[[bytes], T | None]):
        self._head, self._header, self._size, self._decode = head, header, size, decode
        self.pending = bytearray()
        self.frames = self.damaged = 0

    def feed(self, data: bytes, final: bool = False) -> list[T]:
        """Add received bytes; returns the frames that they complete. The last of a transmission if `final`: that drops
        an incomplete frame, and returns the frames inside its bytes."""
        self.pending += data
        buffer, contents, at, done = self.pending, list[T](), 0, 0
        while (at := buffer.find(self._head, at)) >= 0:
            complete = at + self._header <= len(buffer)
            size = self._size(bytes(buffer[at : at + self._header])) if complete else self._header
            end = at + size
            if end > len(buffer) and not final:
                break
            content = None
            if complete and size and end <= len(buffer):
                content = self._decode(bytes(buffer[at:end]))
                self.damaged += content is None
            at += 1
            if content is not None:
                self.frames += 1
                contents.append(content)
                at = done = end
        else:
            # The last bytes may be the beginning of a head.
            parts = (size for size in range(len(self._head) - 1, 0, -1) if buffer.endswith(self._head[:size]))
            at = len(buffer) if final else max(len(buffer) - next(parts, 0), done)
        del buffer[:at]
        return contents
