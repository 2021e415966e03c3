"""Sixteen emulated Dynamixel motors behind a pseudo-terminal; written from the protocol's description, byte by byte.

Shares nothing with `dexsim_real.wire.dynamixel`: another CRC (bit by bit over an integer), another parser (one that
unstuffs as it reads), and a table of single bytes.
"""

import os
import pty
import threading
import tty


def crc(data):
    value = 0
    for byte in data:
        for bit in range(7, -1, -1):
            carry = value >> 15 ^ byte >> bit & 1
            value = value << 1 & 0xFFFF
            value ^= 0x8005 if carry else 0
    return value


def status(motor, error, data):
    body, plain = bytearray(), [0x55, error, *data]
    for byte in plain:
        body.append(byte)
        if body[-3:] == b"\xff\xff\xfd":
            body.append(0xFD)
    size = len(body) + 2
    whole = bytes([0xFF, 0xFF, 0xFD, 0, motor, size & 255, size >> 8]) + bytes(body)
    check = crc(whole)
    return whole + bytes([check & 255, check >> 8])


class DynamixelBus:
    """Motors that go at once to their goal while their torque is on.

    `silent` motors do not answer. `spoil` may change the bytes of an answer: it is called with (motor, bytes).
    """

    def __init__(self, ids):
        self.table = {motor: bytearray(256) for motor in ids}
        for motor, table in self.table.items():
            table[9], table[11] = 250, 3  # as delivered: 500 us, position control
            self.put(motor, 38, 2, 1750)
            self.put(motor, 132, 4, 2048)
            table[146] = 30
        self.silent, self.spoil, self.writes, self.echo = set(), lambda motor, data: data, [], False
        self._near, far = pty.openpty()
        tty.setraw(far)
        self.port, self._far = os.ttyname(far), far
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def put(self, motor, address, size, value):
        self.table[motor][address : address + size] = value.to_bytes(size, "little", signed=value < 0)

    def get(self, motor, address, size):
        return int.from_bytes(self.table[motor][address : address + size], "little")

    def close(self):
        os.close(self._far)
        self._thread.join(5.0)
        os.close(self._near)

    def _serve(self):
        rest = b""
        while True:
            try:
                rest += os.read(self._near, 4096)
            except OSError:
                return
            while len(rest) >= 7:
                end = 7 + rest[5] + 256 * rest[6]
                if len(rest) < end:
                    break
                whole, rest = rest[:end], rest[end:]
                assert whole[:4] == b"\xff\xff\xfd\x00" and crc(whole[:-2]) == whole[-2] + 256 * whole[-1]
                answer = (whole if self.echo else b"") + self._answer(self._unstuffed(whole[7:-2]))
                if answer:
                    os.write(self._near, answer)

    def _unstuffed(self, body):
        plain, at = bytearray(), 0
        while at < len(body):
            plain.append(body[at])
            at += 1 + (plain[-3:] == b"\xff\xff\xfd")
        return bytes(plain)

    def _answer(self, body):
        instruction, address, size = body[0], body[1] + 256 * body[2], body[3] + 256 * body[4]
        if instruction == 0x82:
            answers = b""
            for motor in body[5:]:
                if motor in self.table and motor not in self.silent:
                    alert = 0x80 if self.table[motor][70] else 0
                    answers += self.spoil(motor, status(motor, alert, self.table[motor][address : address + size]))
            return answers
        assert instruction == 0x83
        for at in range(5, len(body), 1 + size):
            self._write(body[at], address, body[at + 1 : at + 1 + size])
        return b""

    def _write(self, motor, address, data):
        self.writes.append((motor, address, bytes(data)))
        table = self.table[motor]
        if address < 64 and table[64]:
            return  # Settings are locked while the torque is on.
        if address == 102 and int.from_bytes(data, "little") > self.get(motor, 38, 2):
            return  # Out of range, and nobody is told.
        table[address : address + len(data)] = data
        if table[70]:
            table[64] = 0  # It has shut down.
        if table[64]:
            table[132:136] = table[116:120]
