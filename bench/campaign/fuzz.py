# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""``make campaign NAME=fuzz``: coverage-guided fuzzing (atheris) of everything that reads what strangers wrote."""

import argparse
import contextlib
import json
import random
import struct
import subprocess
import sys
import tempfile
import time
import zlib
from collections.abc import Callable, Iterator, Mapping
from operator import methodcaller
from pathlib import Path

import zstandard

ROOT = Path(__file__).resolve().parents[2]
MEMORY = '/dev/shm' if Path('/dev/shm').is_dir() else None
LIMITS = ['-timeout=60', '-rss_limit_mb=256', '-max_len=65536']
HANG_S = 1.0
"""More than this in one reading of an input is a hang, in seconds of the processor: libFuzzer's clock runs on while
others have the machine, and stays for what never comes back at all. Coverage makes a reading three times as long."""
Target = Callable[[bytes], list[str]]
"""Reads an input, and returns what the package rejects of it; whatever else it raises is a defect."""


@contextlib.contextmanager
def timed() -> Iterator[None]:
    """AssertionError if what is inside takes longer than ``HANG_S``."""
    began = time.process_time()
    yield
    took = time.process_time() - began
    if took > HANG_S:
        raise AssertionError(f'{took:.1f} s for one input')


def evaluated(target: Target, content: bytes) -> list[str]:
    """``target(content)``. AssertionError if a rejection is not one line."""
    rejected = target(content)
    for text in rejected:
        if '\n' in text:
            raise AssertionError(f'more than one line: {text!r}')
    return rejected


def frames_target() -> tuple[Target, list[bytes]]:
    """The decoder: whole, and byte by byte, gives the same."""
    from psd_deflection.devices.protocol import frames
    from psd_deflection.devices.protocol.frames import BadFrame, FrameDecoder, SampleFrame, encode
    from psd_deflection.records import MOST_PSDS

    @timed()
    def target(stream: bytes) -> list[str]:
        stream = stream[:4096]
        # The first byte chooses of how many PSDs a sample is.
        psds = 2 + (stream[0] if stream else 0) % (MOST_PSDS - 1)
        full = FrameDecoder(psds).feed(b'\x00' + stream)
        pieces = FrameDecoder(psds)
        apart = pieces.feed(b'\x00')
        for i in range(len(stream)):
            apart += pieces.feed(stream[i : i + 1])
        # By text: NaN in a HELLO is not equal to itself.
        if repr(full) != repr(apart):
            raise AssertionError(f'{apart} byte by byte, but {full} whole')
        return [f.reason for f in full if isinstance(f, BadFrame)]

    seeds = [
        *(bytes((n - 2,)) + encode(SampleFrame(0, 1, 1000, tuple(range(3 * n)))) for n in range(2, MOST_PSDS + 1)),
        *(encode(frames.StatusFrame(3, None)), encode(frames.HelloFrame(1, {'serial': 'A'}))),
        encode(frames.PingFrame(7)),
    ]
    return target, seeds


def _file_target(suffix: str, *steps: Callable[[Path], object]) -> Target:
    """Writes the input to a file, and reads that by each of ``steps``."""
    from psd_deflection.base.errors import PsdDeflectionError

    path = Path(tempfile.mkdtemp(dir=MEMORY)) / f'input{suffix}'

    def target(content: bytes) -> list[str]:
        path.write_bytes(content)
        rejected = []
        for step in steps:
            try:
                with timed():
                    step(path)
            except PsdDeflectionError as error:
                rejected.append(str(error))
        path.with_name(path.name + '.cut').unlink(missing_ok=True)
        return rejected

    return target


def bag_target() -> tuple[Target, list[bytes]]:
    """A lone ``.mcap``: everything that a command may ask of it; and ``recover``."""
    from psd_deflection.recordings.read.readers import open_recording
    from psd_deflection.recordings.repair import recover
    from psd_deflection.recordings.write.bag_writer import McapFile
    from psd_deflection.records import AppliedLoad
    from psd_deflection.rig.config import load_rig

    with tempfile.TemporaryDirectory() as name:
        seed = Path(name) / 'seed.mcap'
        with McapFile(seed, rig_values=dict(list(load_rig().values.items())[:3]), device_hello={'serial': 'A'}) as out:
            out.put(AppliedLoad(1, 1.0, 2.0, 3.0))
        small = seed.read_bytes()
    golden = next(iter(sorted((ROOT / 'bags').glob('*/*.mcap')))).read_bytes()
    target = _file_target(
        '.mcap',
        recover,
        lambda path: sum(len(b.seq) for b in open_recording(path).blocks()),
        lambda path: open_recording(path).loads(),
        lambda path: open_recording(path).estimates(),
        lambda path: open_recording(path).topics(),
    )
    return target, [golden[:60_000], small]


def csv_target() -> tuple[Target, list[bytes]]:
    from psd_deflection.recordings.read.readers import open_recording

    seed = b't,x1,y1,sum1,x2,y2,sum2,load_fx,load_fy,load_tz\n'
    seed += b''.join(b'%d.%03d,0,1e-3,5,-1,2,5,1,0,0\n' % (i // 1000, i % 1000) for i in range(30))
    parts = [methodcaller(name) for name in ('blocks', 'loads', 'references', 'temperatures')]
    return _file_target('.csv', *(lambda path, part=part: list(part(open_recording(path))) for part in parts)), [seed]


def parameters_target() -> tuple[Target, list[bytes]]:
    """A parameter file, and the rig of it; the kept zero as well."""
    from psd_deflection.rig.config import load_rig
    from psd_deflection.run.state import ZeroStore

    nominal = load_rig()

    def load_zero(path: Path) -> None:
        _, message, _ = ZeroStore(load_rig(None, {'zero_file': str(path)}), 'A').load(nominal)
        if '\n' in message:
            raise AssertionError(f'more than one line: {message!r}')

    return _file_target('.yaml', load_rig, load_zero), [
        (ROOT / 'config' / 'thesis_rig.yaml').read_bytes(),
        b'{"configured": {"psd_1.zero": [0.0, 0.0]}, "psd_1.zero": [0, 0], "psd_2.zero": [0, 0]}',
        b'a: &a [*a, 1]\n/**:\n  ros__parameters: {link: {length: 1}}\n',
    ]


class Choices:
    """The bytes of an input, taken as decisions; zeros when they are used up."""

    def __init__(self, content: bytes) -> None:
        self._content = content
        self._at = 0

    def __bool__(self) -> bool:
        return self._at < len(self._content)

    def take(self, size: int) -> bytes:
        piece = self._content[self._at : self._at + size]
        self._at += size
        return piece.ljust(size, b'\0')

    def below(self, limit: int) -> int:
        """A number from 0 to ``limit`` - 1."""
        return int.from_bytes(self.take(1 if limit <= 256 else 4), 'little') % limit

    def text(self) -> str:
        """A short text of any characters, lone surrogates among them."""
        return ''.join(chr(int.from_bytes(self.take(2), 'little')) for _ in range(self.below(7)))

    def value(self, depth: int = 0) -> object:
        """What JSON and YAML can say."""
        kind = self.below(9 if depth < 4 else 7)
        if kind < 3:
            return (None, True, False)[kind]
        if kind == 3:
            return int.from_bytes(self.take(4), 'little', signed=True) * 10 ** (self.below(2) * self.below(400))
        if kind == 4:
            return float(struct.unpack('<d', self.take(8))[0])
        if kind < 7:
            return self.text() if kind == 5 else 'x' * self.below(3000)
        if kind == 7:
            return [self.value(depth + 1) for _ in range(self.below(6))]
        return {self.text(): self.value(depth + 1) for _ in range(self.below(6))}


def hello_words(choices: Choices, good: Mapping[str, object]) -> dict[str, object]:
    """``good`` with up to two entries of any name and value."""
    info = dict(good)
    for _ in range(choices.below(3)):
        key = [*good, choices.text()][choices.below(len(good) + 1)]
        info[key] = choices.value()
    return info


def hello_target() -> tuple[Target, list[bytes]]:
    """A HELLO of any words, as a frame, through the gate: what is taken is printable, bounded, and can be recorded."""
    from psd_deflection.base.errors import DeviceError
    from psd_deflection.devices.protocol.frames import FrameDecoder, HelloFrame, encode
    from psd_deflection.records import CHANNELS
    from psd_deflection.rig.config import load_rig
    from psd_deflection.run.hello import HelloGate

    rig = load_rig()
    good: dict[str, object] = {'serial': 'A', 'firmware': '1', 'sample_rate_hz': 1000.0, 'channels': list(CHANNELS)}
    good['volts_per_count'] = rig.converter.volts_per_count

    @timed()
    def target(content: bytes) -> list[str]:
        choices = Choices(content)
        gate = HelloGate(rig)
        rejected = []
        while choices:
            try:
                frames = FrameDecoder().feed(b'\0' + encode(HelloFrame(1, hello_words(choices, good))))
            except (ValueError, OverflowError):
                # It does not fit into a frame.
                continue
            for frame in (f for f in frames if isinstance(f, HelloFrame)):
                try:
                    gate.take(frame, 'port', volts=False)
                except DeviceError as error:
                    rejected.append(str(error)[:300])
            if gate.hello is not None:
                words = json.dumps(gate.hello.info, allow_nan=False, ensure_ascii=False)
                rate = gate.hello.info['sample_rate_hz']
                if not words.isprintable() or not isinstance(rate, int | float) or not abs(rate - 1000.0) <= 1.0:
                    raise AssertionError(f'taken: {words!r}')
        return rejected

    return target, [b'\0\0', bytes(range(256))]


def _records(choices: Choices, channels: int, depth: int = 0) -> bytes:
    """MCAP records whose lengths and CRCs are right, of contents that mostly are."""

    def text() -> bytes:
        known = (b'/psd/samples', b'/link_tip/load', b'cdr', b'sensor_msgs/msg/PointCloud2', b'psd_deflection.change.1')
        content = known[choices.below(5)] if choices.below(4) else choices.take(choices.below(20))
        return struct.pack('<I', len(content)) + content

    def pairs() -> bytes:
        content = b''.join(text() + text() for _ in range(choices.below(3)))
        return struct.pack('<I', len(content)) + content

    out = []
    for _ in range(choices.below(12)):
        if not choices:
            break
        kind = choices.below(8)
        number = struct.pack('<H', choices.below(channels))
        if kind == 0:
            opcode, content = 3, number + text() + text() + struct.pack('<I', 0)
        elif kind == 1:
            opcode, content = 4, number + number + text() + text() + pairs()
        elif kind == 2:
            opcode, content = 12, text() + pairs()
        elif kind < 6:
            body = choices.take(choices.below(120)) * (1 + choices.below(200) * (kind == 5))
            opcode, content = 5, number + choices.take(20) + body
        elif kind == 6 and depth == 0:
            plain = _records(choices, channels, 1) * (1 + choices.below(2000))
            head = struct.pack('<QQQI', 0, 0, len(plain), zlib.crc32(plain))
            packed = zstandard.compress(plain)
            opcode = 6
            content = head + struct.pack('<I', 4) + b'zstd' + struct.pack('<Q', len(packed)) + packed
        else:
            opcode, content = choices.below(256), choices.take(choices.below(30))
        out.append(struct.pack('<BQ', opcode, len(content)) + content)
    return b''.join(out)


def records_target() -> tuple[Target, list[bytes]]:
    """As ``bag``, of records with right lengths and CRCs, packed in chunks and many times over."""
    target, _ = bag_target()
    start = b'\x89MCAP0\r\n'

    def built(content: bytes) -> list[str]:
        choices = Choices(content[:4096])
        tail = start if choices.below(2) else b''
        records = b''.join(_records(choices, 4) for _ in range(4))
        # As long as what ``bag`` reads: time is judged, and a longer file may take longer.
        return target(start + records[:60_000] + tail)

    return built, [bytes(range(256)), bytes([1, 11, 1, 1, 0, 0, 0, 1, 3, 5] * 40)]


def yaml_target() -> tuple[Target, list[bytes]]:
    """A parameter file and a ``metadata.yaml`` that are YAML, with anchors, aliases, merge keys and tags."""
    from psd_deflection.base.errors import PsdDeflectionError
    from psd_deflection.recordings.read.bag_reader import read_information
    from psd_deflection.rig.config import load_rig
    from psd_deflection.rig.declarations import BY_NAME

    names = [*BY_NAME]
    tags = ('', '!!int ', '!!float ', '!!bool ', '!!timestamp ', '!!binary ', '!!set ', '!!python/name:os.system ')

    def message(choices: Choices, depth: int, anchors: list[str]) -> str:
        kind = choices.below(10)
        if anchors and kind == 0:
            return '*' + anchors[choices.below(len(anchors))]
        anchor = ''
        if kind == 1:
            anchors.append(f'a{len(anchors)}')
            anchor = f'&{anchors[-1]} '
        if depth < 8 and kind in (2, 3):
            return anchor + '[' + ', '.join(message(choices, depth + 1, anchors) for _ in range(choices.below(8))) + ']'
        if depth < 8 and kind in (4, 5):
            keys = (names[choices.below(len(names))] if choices.below(3) else '<<' for _ in range(choices.below(8)))
            return anchor + '{' + ', '.join(f'{k}: {message(choices, depth + 1, anchors)}' for k in keys) + '}'
        return anchor + tags[choices.below(len(tags))] + json.dumps(choices.value(4))

    path = Path(tempfile.mkdtemp(dir=MEMORY)) / 'input.yaml'

    @timed()
    def target(content: bytes) -> list[str]:
        text = message(Choices(content), 0, [])
        rejected = []
        for head, read in (('/**: {ros__parameters: ', load_rig), ('rosbag2_bagfile_information: ', read_information)):
            path.write_text(head + text + ('}' if head.startswith('/') else ''), errors='replace')
            try:
                read(path)
            except PsdDeflectionError as error:
                rejected.append(str(error))
        return rejected

    return target, [bytes([4, 3, 1, 5, 2, 0, 4, 1]) * 20, bytes(range(256))]


GRAMMARS = ('hello', 'records', 'yaml')  # Targets whose input is a list of choices: any bytes are an input.
EVERY = (frames_target, hello_target, bag_target, records_target, csv_target, parameters_target, yaml_target)
TARGETS: dict[str, Callable[[], tuple[Target, list[bytes]]]] = {f.__name__.removesuffix('_target'): f for f in EVERY}
"""Each target with inputs to begin from, of which the first is whole."""


def corrupted(count: int) -> int:
    """Damage ``count`` sample frames; how many are accepted with another content than was sent."""
    from psd_deflection.devices.protocol.frames import BadFrame, FrameDecoder, SampleFrame, encode

    chance = random.Random(1)
    originals = []
    for i in range(256):
        counts = tuple(chance.randrange(-32768, 32768) for _ in range(6))
        frame = SampleFrame(i & 3, chance.getrandbits(32), chance.getrandbits(40), counts)
        originals.append((frame, encode(frame)))
    decoder = FrameDecoder()
    decoder.feed(b'\x00')
    wrong = same = rejected = lost = 0
    bits, below = chance.getrandbits, chance.randrange
    for number in range(count):
        frame, sent = originals[number & 255]
        damaged = bytearray(sent)
        kind = number % 5
        if kind == 0:
            for _ in range(1 + number % 7):
                damaged[below(len(sent) - 1)] ^= 1 << bits(3)
        elif kind == 1:
            start, length = below(len(sent) - 1), 1 + bits(3)
            damaged[start : start + length] = bytes(bits(8) for _ in range(length))
        elif kind == 2:
            del damaged[below(len(sent) - 1)]
        elif kind == 3:
            damaged[below(len(sent)) : 0] = bytes((bits(8),))
        else:
            damaged[:-1] = bits(8 * (len(sent) - 1)).to_bytes(len(sent) - 1, 'little')
        accepted = [f for f in decoder.feed(bytes(damaged) + b'\x00') if type(f) is not BadFrame]
        if not accepted:
            rejected += 1
        elif accepted == [frame]:
            same += 1
        elif any(type(f) is SampleFrame and f != frame for f in accepted):
            wrong += 1
            print(f'accepted with another content: {bytes(damaged).hex()}')
        else:
            lost += 1
    print(f'{count} damaged frames: {rejected} rejected, {same} came out as they were sent,', end=' ')
    chance_alone = f'(chance alone: {count * 2.0**-32:.4f})'
    print(f'{lost} taken for another kind, {wrong} accepted with a wrong content {chance_alone}')
    return 1 if wrong else 0


def everything(words: list[str]) -> int:
    """All of it, one after the other; the exit status of the first that fails."""
    parser = argparse.ArgumentParser()
    parser.add_argument('--seconds', type=float, default=600.0, help='of each target and of the messages')
    parser.add_argument('--frames', type=int, default=10_000_000)
    options = parser.parse_args(words)
    runs = [['fuzz', 'corrupted', str(options.frames)]]
    runs.append(['messages', '--minutes', str(max(options.seconds, 20.0) / 60.0)])
    runs += [['fuzz', target, f'-max_total_time={options.seconds:.0f}'] for target in TARGETS]
    for module, *arguments in runs:
        command = [sys.executable, '-m', f'bench.campaign.{module}', *arguments]
        if status := subprocess.run(command, check=False).returncode:
            return status
    return 0


def main() -> int:
    if sys.argv[1:2] == ['all']:
        return everything(sys.argv[2:])
    if len(sys.argv) > 2 and sys.argv[1] == 'corrupted':
        return corrupted(int(sys.argv[2]))
    if len(sys.argv) < 2 or sys.argv[1] not in TARGETS:
        print(f'TARGET of {", ".join(TARGETS)}, with options of libFuzzer; or corrupted N; or all', file=sys.stderr)
        return 2
    import atheris

    name = sys.argv[1]
    with atheris.instrument_imports(include=['psd_deflection', 'msg_adapters', 'yaml']):
        target, seeds = TARGETS[name]()
    corpus = Path(tempfile.mkdtemp())
    for i, seed in enumerate(seeds):
        (corpus / f'seed_{i}').write_bytes(seed)
    crashes = ROOT / 'build' / 'fuzz'
    crashes.mkdir(parents=True, exist_ok=True)

    def one_input(content: bytes) -> None:
        evaluated(target, content)

    atheris.Setup([sys.argv[0], str(corpus), *LIMITS, f'-artifact_prefix={crashes}/{name}_', *sys.argv[2:]], one_input)
    atheris.Fuzz()
    return 0


if __name__ == '__main__':
    sys.exit(main())
