# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A device written from ``docs/protocol.md`` alone: nothing of ``psd_deflection`` is imported here.

It is the page's judge: where the daemon does not get on with it, page or daemon is wrong. Run it as a
program and it prints the name of its port.
"""

import errno
import json
import os
import select
import struct
import sys
import time
import tty
import zlib

RATE_HZ = 1000
VOLTS_PER_COUNT = 10 / 32768
SAMPLE, STATUS, HELLO, HELLO_QUERY, PING, PONG, START, STOP = 0x01, 0x02, 0x10, 0x11, 0x12, 0x13, 0x14, 0x15
OUTPUT_ROOM = 2048


def stuff(payload: bytes) -> bytes:
    """COBS: pieces that end at a zero or at 254 bytes, each after its length plus one."""
    out = bytearray()
    piece = bytearray()
    full = False
    for byte in payload:
        full = False
        if byte == 0:
            out.append(len(piece) + 1)
            out += piece
            piece.clear()
            continue
        piece.append(byte)
        if len(piece) == 254:
            out.append(255)
            out += piece
            piece.clear()
            full = True
    if not full:
        out.append(len(piece) + 1)
        out += piece
    return bytes(out)


def unstuff(encoded: bytes) -> bytes | None:
    """The payload, or None where it is no COBS."""
    out = bytearray()
    at = 0
    while at < len(encoded):
        code = encoded[at]
        piece = encoded[at + 1 : at + code]
        if code == 0 or len(piece) != code - 1 or 0 in piece:
            return None
        out += piece
        at += code
        if code != 255 and at < len(encoded):
            out.append(0)
    return bytes(out)


def frame(kind: int, body: bytes = b'') -> bytes:
    content = bytes([kind]) + body
    return stuff(content + struct.pack('<I', zlib.crc32(content))) + b'\x00'


def unframe(encoded: bytes) -> tuple[int, bytes] | None:
    """Type and body of what stood before a zero, or None where it is no frame."""
    payload = unstuff(encoded)
    if payload is None or len(encoded) > 512 or len(payload) < 5:
        return None
    content, check = payload[:-4], payload[-4:]
    if struct.pack('<I', zlib.crc32(content)) != check:
        return None
    return content[0], content[1:]


class Emulator:
    """Sample k is taken k milliseconds after power-up; a slow ramp on x1, laser sums at 5 V."""

    def __init__(self, first_seq: int = 0) -> None:
        self.first_seq = first_seq
        self.taken = 0
        self.overruns = 0
        self.dropping = False
        self.streaming = True
        self.heard = b''

    def hello(self) -> bytes:
        about = {
            'serial': 'SECOND-7',
            'firmware': 'emulator from the protocol page',
            'sample_rate_hz': RATE_HZ,
            'channels': ['x1', 'y1', 'sum1', 'x2', 'y2', 'sum2'],
            'volts_per_count': VOLTS_PER_COUNT,
        }
        return frame(HELLO, b'\x01' + json.dumps(about).encode('utf-8'))

    def status(self) -> bytes:
        return frame(STATUS, struct.pack('<Ih', self.overruns, 32767))

    def receive(self, received: bytes, now_us: int) -> bytes:
        """Answers to the host."""
        *full, self.heard = (self.heard + received).split(b'\x00')
        self.heard = self.heard[-512:]
        answers = b''
        for encoded in full:
            message = unframe(encoded)
            if message is None:
                continue
            kind, body = message
            if kind == HELLO_QUERY and not body:
                answers += self.hello()
            elif kind == PING and len(body) == 8:
                answers += frame(PONG, body + struct.pack('<Q', now_us))
            elif kind == START and not body:
                self.streaming = True
            elif kind == STOP and not body:
                self.streaming = False
        return answers

    def until(self, now_us: int, room: int) -> bytes:
        """Take the samples that are due; the bytes to send, as far as there is room."""
        out = b''
        while self.taken * 1_000_000 // RATE_HZ <= now_us:
            number, self.taken = self.taken, self.taken + 1
            if self.streaming and len(out) >= room:
                self.overruns += 1
                self.dropping = True
            elif self.streaming:
                # A real converter is never still.
                still = number * 7919 % 13 - 6
                counts = (number % 2000, still - 100, 16384 + still, 50 - still, 25 + still, 16384 - still)
                seq = (self.first_seq + number) % 2**32
                body = struct.pack('<BIQ6h', 2 if self.dropping else 0, seq, number * 1_000_000 // RATE_HZ, *counts)
                self.dropping = False
                out += frame(SAMPLE, body)
            if number % RATE_HZ == 0 and len(out) < room:
                out += self.hello() + self.status()
        return out


def main() -> None:
    """Serve on a pseudo-terminal until the standard input ends."""
    master, slave = os.openpty()
    tty.setraw(slave)
    print(os.ttyname(slave), flush=True)
    os.set_blocking(master, False)
    emulator = Emulator(int(sys.argv[1]) if len(sys.argv) > 1 else 0)
    started = time.monotonic()
    waiting = b''
    while True:
        ready, _, _ = select.select((master, sys.stdin), (), (), 0.0005)
        if sys.stdin in ready and not sys.stdin.readline():
            return
        now_us = int((time.monotonic() - started) * 1e6)
        try:
            if master in ready:
                waiting += emulator.receive(os.read(master, 4096), now_us)
            waiting += emulator.until(now_us, OUTPUT_ROOM - len(waiting))
            waiting = waiting[os.write(master, waiting) :] if waiting else b''
        except BlockingIOError:
            pass
        except OSError as error:
            if error.errno != errno.EIO:
                raise


if __name__ == '__main__':
    main()
