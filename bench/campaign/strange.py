# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Messages of any content: a good one, of which some fields have any value that their type allows, and worse ones."""

import random
import re
import struct
import time
from typing import Any, TypeVar

from rclpy.serialization import serialize_message

NUMBERS = (float('nan'), float('inf'), -float('inf'), 1e300, -1e308, 5e-324, 1e-200, -0.0, 1e4, 10.0, 1.0, -1.0, 0.0)
WIDEST = 3.4e38  # A float32 is at most this.
TEXTS = (
    *('', ' ', 'world', 'link_base', '/x', '~', '\x1b[31mred\n\r\t\a', 'ä' * 100, '\u202e𝛑\x00end', '%s%n{0}'),
    *('../../etc', 'a' * 70_000, 'nan', '1e400', 'mono16', 'bayer_rggb8', '16UC1', 'rgba8'),
)
HUGE = (1000, 5000, 20_000)  # Elements of a list that is too long.
SHARES = (0.0, 0.0, 0.03, 0.2, 1.0)  # Of the fields of a message, how many get another value.
MAGIC = (
    *(b'GIF89a', b'BM', b'II*\x00\x08\x00\x00\x00', b'MM\x00*', b'RIFF\xff\xff\xff\xffWEBPVP8X'),
    b'P5 99999 99999 255\n',
)
_SEQUENCE = re.compile(r'(?:sequence<(?P<of>.+?)(?:, \d+)?>|(?P<array>.+)\[(?P<count>\d+)\])$')
_INTEGER = re.compile(r'(?P<sign>u?)int(?P<bits>\d+)$|(?P<byte>octet|byte|char)$')
T = TypeVar('T', str, bytes)


class Stranger:
    """Makes messages strange, by chance; the same ``seed`` makes the same."""

    def __init__(self, seed: int) -> None:
        self.chance = random.Random(seed)

    def change(self, message: Any, share: float | None = None) -> Any:
        """``message``, of whose fields a ``share`` has another value, by chance 0."""
        share = self.chance.choice(SHARES) if share is None else share
        if not share:
            return message
        for name, kind in message.get_fields_and_field_types().items():
            value = getattr(message, name)
            if hasattr(value, 'get_fields_and_field_types'):
                if kind == 'builtin_interfaces/Time':
                    setattr(message, name, self._stamp(value))
                else:
                    self.change(value, share)
            elif self.chance.random() < share or _SEQUENCE.match(kind):
                setattr(message, name, self._value(kind, value, share))
        return message

    def encode(self, message: Any) -> tuple[bytes, bool]:
        """The message as it is sent, and whether it was damaged on the way, as one in twenty is."""
        chance = self.chance
        content = bytearray(serialize_message(message))
        damaged = chance.random() < 0.05
        if damaged:
            kind = chance.randrange(4)
            if kind == 0:
                del content[chance.randrange(len(content)) :]
            elif kind == 1:
                content[chance.randrange(len(content))] ^= 1 << chance.randrange(8)
            elif kind == 2:
                # A length, perhaps.
                at = chance.randrange(0, len(content), 4)
                content[at : at + 4] = struct.pack('<I', chance.choice((2**32 - 1, 2**31, 10**6, 0)))
            else:
                content = bytearray(chance.randbytes(chance.randrange(200)))
        return bytes(content), damaged

    def number(self, usual: float) -> float:
        kind = self.chance.random()
        if kind < 0.3:
            return usual + self.chance.gauss(0.0, 0.02)
        if kind < 0.9:
            return self.chance.choice(NUMBERS)
        return float(struct.unpack('<d', self.chance.randbytes(8))[0])

    def _stamp(self, value: Any) -> Any:
        chance = self.chance
        if chance.random() < 0.6:
            return value
        out = type(value)()
        if chance.random() < 0.3:
            out.sec = chance.choice((0, -1, -(2**31), 2**31 - 1))
            out.nanosec = chance.choice((0, 999_999_999, 10**9, 2**32 - 1))
            return out
        away = chance.choice((-(10**9), -(10**7), 10**8, 3600 * 10**9, -3600 * 10**9))
        out.sec, out.nanosec = divmod(time.time_ns() + away, 10**9)
        return out

    def _value(self, kind: str, value: Any, share: float) -> Any:
        listed = _SEQUENCE.match(kind)
        if listed is not None:
            return self._list(listed['of'] or listed['array'], value, listed['count'] is not None, share)
        return self._single(kind, value)

    def _single(self, kind: str, value: Any) -> Any:
        if kind in ('double', 'float'):
            out = self.number(value)
            return out if kind == 'double' or not WIDEST < abs(out) < float('inf') else self.chance.choice((0.0, 1.0))
        if kind == 'boolean':
            return self.chance.random() < 0.5
        if kind.startswith(('string', 'wstring')):
            return self.text(value)
        match = _INTEGER.match(kind)
        if match is None:
            raise TypeError(f'{kind}: no field of this type can be made strange yet')
        bits = 8 if match['byte'] else int(match['bits'])
        signed = match['sign'] == '' and not match['byte']
        low, high = (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) if signed else (0, 2**bits - 1)
        out = self.chance.choice((low, high, 0, 1, value + 1, value - 1, self.chance.randint(low, high)))
        clipped = max(low, min(high, out))
        return bytes([clipped]) if match['byte'] and isinstance(value, bytes) else clipped

    def text(self, usual: str) -> str:
        if self.chance.random() < 0.1:
            return usual + str(self.chance.getrandbits(40))
        if len(usual) > 200 and self.chance.random() < 0.8:
            return self._spliced(usual)
        out = self.chance.choice(TEXTS)
        return out if len(out) < 1000 or self.chance.random() < 0.05 else out[:20]

    def _spliced(self, usual: T) -> T:
        """A text or bytes of which a piece is gone, or stands somewhere else again and again."""
        chance, out = self.chance, usual
        for _ in range(chance.choice((1, 1, 3))):
            a, b = sorted(chance.choices(range(len(out) + 1), k=2))
            at, piece = chance.randrange(len(out) + 1), out[a:b] * chance.choice((1, 2, 50))
            out = out[:a] + out[b:] if chance.random() < 0.5 else out[:at] + piece + out[at:]
        return out

    def _list(self, of: str, value: Any, fixed: bool, share: float) -> Any:
        chance = self.chance
        if of in ('uint8', 'octet', 'char', 'byte') and not fixed:
            return self.content(bytes(value)) if chance.random() < max(share, 0.2) else value
        out = list(value)
        if '/' in of:
            for element in out:
                self.change(element, share)
        else:
            out = [self._single(of, element) if chance.random() < share else element for element in out]
        if fixed or chance.random() > 0.3:
            return out
        return self._of_another_length(of, out)

    def _of_another_length(self, of: str, out: list[Any]) -> list[Any]:
        chance = self.chance
        kind = chance.randrange(6)
        if kind < 2 or not out:
            return out[:-1] if kind == 1 else []
        if kind < 4:
            return [*out, chance.choice(out)] if kind == 2 else out[::-1]
        if kind == 4 and chance.random() < 0.02:
            return (out * chance.choice(HUGE))[: chance.choice(HUGE)]
        if '/' not in of:
            return [self._single(of, out[0]) for _ in range(chance.choice((1, 3, 50)))]
        return out

    def content(self, content: bytes) -> bytes:
        """Other bytes of an image, or of anything."""
        chance = self.chance
        kind = chance.randrange(7)
        if kind == 0 or not content:
            return chance.choice((b'', bytes(1), chance.randbytes(100)))
        if kind in (1, 2):
            return content[: chance.randrange(len(content))] if kind == 1 else content + chance.randbytes(50)
        if kind in (3, 4):
            splices = kind == 4
            return self._spliced(content) if splices else chance.choice(MAGIC) + chance.randbytes(chance.randrange(64))
        out = bytearray(content)
        for _ in range(chance.choice((1, 10, 1000))):
            # Of a JPEG the headers are at the start.
            out[chance.randrange(chance.choice((len(out), min(len(out), 600))))] = chance.getrandbits(8)
        return bytes(out)
