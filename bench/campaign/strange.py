# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Messages of any content: a good one, of which some fields have any value that their type allows, and worse ones."""

import random
import re
import struct
import time
import zlib
from typing import Any

from rclpy.serialization import serialize_message

NUMBERS = (float('nan'), float('inf'), -float('inf'), 1e300, -1e308, 5e-324, 1e-200, -0.0, 1e4, 10.0, 1.0, -1.0, 0.0)
WIDEST = 3.4e38  # A float32 is at most this.
TEXTS = (
    '',
    ' ',
    'world',
    'link_base',
    '/x',
    '~',
    '\x1b[31mred\n\r\t\a',
    'ä' * 100,
    '\u202e𝛑\x00end',
    '%s%n{0}',
    '../../etc',
    'a' * 70_000,
    'nan',
    '1e400',
    'mono16',
    'bayer_rggb8',
    '16UC1',
    'rgba8',
)
HUGE = (1000, 5000, 20_000)  # Elements of a list that is too long.
SHARES = (0.0, 0.0, 0.03, 0.2, 1.0)  # Of the fields of a message, how many get another value.
PNG = b'\x89PNG\r\n\x1a\n'
MAGIC = (
    b'GIF89a',
    b'BM',
    b'II*\x00\x08\x00\x00\x00',
    b'MM\x00*',
    b'RIFF\xff\xff\xff\xffWEBPVP8X',
    b'P5 99999 99999 255\n',
)
_SEQUENCE = re.compile(r'(?:sequence<(?P<of>.+?)(?:, \d+)?>|(?P<array>.+)\[(?P<count>\d+)\])$')
_INTEGER = re.compile(r'(?P<sign>u?)int(?P<bits>\d+)$|(?P<byte>octet|byte|char)$')


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
        """One that is as usual, or not."""
        kind = self.chance.random()
        if kind < 0.3:
            return usual + self.chance.gauss(0.0, 0.02)
        if kind < 0.9:
            return self.chance.choice(NUMBERS)
        (out,) = struct.unpack('<d', self.chance.randbytes(8))
        return float(out)

    def _stamp(self, value: Any) -> Any:
        """Of now, mostly."""
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
        low, high = (
            (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) if match['sign'] == '' and not match['byte'] else (0, 2**bits - 1)
        )
        out = self.chance.choice((low, high, 0, 1, value + 1, value - 1, self.chance.randint(low, high)))
        clipped = max(low, min(high, out))
        return bytes([clipped]) if match['byte'] and isinstance(value, bytes) else clipped

    def text(self, usual: str) -> str:
        """Another one, which is mostly short."""
        if self.chance.random() < 0.1:
            return usual + str(self.chance.getrandbits(40))
        if usual.lstrip().startswith('<') and self.chance.random() < 0.8:
            return self._xml(usual)
        out = self.chance.choice(TEXTS)
        return out if len(out) < 1000 or self.chance.random() < 0.05 else out[:20]

    def _xml(self, usual: str) -> str:
        """Another one, of which an attribute or a part is other."""
        chance, out = self.chance, usual
        for _ in range(chance.choice((1, 1, 3))):
            values = list(re.finditer(r'="([^"]*)"', out))
            parts = list(re.finditer(r'<[^>]*>', out))
            if not values or not parts:
                break
            kind, value, part = chance.randrange(4), chance.choice(values), chance.choice(parts)
            if kind < 2:
                new = chance.choice((repr(self.number(1.0)), *TEXTS[:6], '1_0', '٣', '1 2', chance.choice(values)[1]))
                out = out[: value.start(1)] + new + out[value.end(1) :]
            elif kind == 2:
                out = out[: part.start()] + out[part.end() :]
            else:
                out = (
                    out[: part.end()]
                    + chance.choice((part[0], part[0] * 5000, '<!ENTITY x "y">', '&x;'))
                    + out[part.end() :]
                )
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
        if kind == 0 or not out:
            return []
        if kind == 1:
            return out[:-1]
        if kind == 2:
            return [*out, chance.choice(out)]
        if kind == 3:
            return out[::-1]
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
        if kind == 1:
            return content[: chance.randrange(len(content))]
        if kind == 2:
            return content + chance.randbytes(50)
        if kind == 3:
            return chance.choice(MAGIC) + chance.randbytes(chance.randrange(64))
        if content.startswith(PNG) and kind < 6:
            return self._png(content)
        if content.startswith(b'\xff\xd8') and kind < 6:
            return self._jpeg(content)
        out = bytearray(content)
        for _ in range(chance.choice((1, 10, 1000))):
            out[chance.randrange(len(out))] = chance.getrandbits(8)
        return bytes(out)

    def _png(self, content: bytes) -> bytes:
        """A PNG, one of whose chunks says something else, with the right checksum."""
        chance, chunks, at = self.chance, [], len(PNG)
        while at + 12 <= len(content):
            (length,) = struct.unpack_from('>I', content, at)
            chunks.append((content[at + 4 : at + 8], content[at + 8 : at + 8 + length]))
            at += 12 + length
        kind = chance.randrange(4)
        if kind == 0:
            head = bytearray(chunks[0][1])
            if chance.random() < 0.5:
                size = chance.choice((0, 1, 16_000, 65_535, 2**31 - 1, 2**32 - 1))
                struct.pack_into('>I', head, chance.choice((0, 4)), size)
            else:
                head[chance.randrange(8, 13)] = chance.choice((0, 1, 2, 3, 4, 6, 8, 16, 255))
            chunks[0] = (chunks[0][0], bytes(head))
        elif kind == 1:
            new = chance.choice(
                (b'tEXt', b'zTXt', b'iCCP', b'PLTE', b'tRNS', b'acTL', b'fcTL', b'eXIf', b'IDAT', b'IEND')
            )
            text = chance.choice((b'', chance.randbytes(40), b'k\0\0' + zlib.compress(bytes(2_000_000))))
            chunks.insert(chance.randrange(len(chunks) + 1), (new, text))
        elif kind == 2:
            del chunks[chance.randrange(len(chunks))]
        else:
            chunks.append(chance.choice(chunks))
        out = bytearray(PNG)
        for name, body in chunks:
            length = len(body) if chance.random() < 0.97 else chance.choice((0, 2**31 - 1, 2**32 - 1, len(body) + 1))
            out += struct.pack('>I', length) + name + body + struct.pack('>I', zlib.crc32(name + body))
        return bytes(out)

    def _jpeg(self, content: bytes) -> bytes:
        """A JPEG, one of whose headers says something else."""
        chance, out = self.chance, bytearray(content)
        marks = [m.start() for m in re.finditer(rb'\xff[\xc0-\xfe]', content[:2000])]
        at = chance.choice(marks)
        kind = chance.randrange(4)
        if kind == 0:
            frame = content.find(b'\xff\xc0')
            struct.pack_into('>HH', out, max(frame, 0) + 5, *(chance.choice((0, 1, 8000, 65_535)) for _ in range(2)))
        elif kind == 1:
            struct.pack_into('>H', out, min(at + 2, len(out) - 2), chance.choice((0, 1, 2, 65_535)))
        elif kind == 2:
            out[at + 1] = chance.choice((0xC1, 0xC2, 0xC4, 0xC8, 0xD0, 0xD9, 0xDA, 0xDB, 0xDD, 0xFE))
        else:
            out[at:at] = b'\xff\xe1' + struct.pack('>H', 200) + chance.randbytes(chance.choice((0, 198, 5000)))
        return bytes(out)
