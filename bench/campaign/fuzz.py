"""``make fuzz``: coverage-guided fuzzing (atheris) of everything that reads what strangers wrote.

A target must answer any bytes with a result or with one of the package's own errors, in one line,
within a second and 256 MB. Inputs that were found to break it become tests (``test/data/fuzz``).

  python -m bench.campaign.fuzz frames -max_total_time=600
  python -m bench.campaign.fuzz corrupted 10000000

Targets: frames, bag, csv, parameters; ``corrupted N`` counts damaged frames instead.
"""

from __future__ import annotations

import random
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
LIMITS = ['-timeout=60', '-rss_limit_mb=256', '-max_len=65536']

HANG_S = 1.0
"""More than this on one input is a hang, in seconds of the processor: libFuzzer's clock runs on while
others have the machine, and stays for what never comes back at all."""

Target = Callable[[bytes], list[str]]
"""Reads an input, and returns what the package refuses of it; whatever else it raises is a defect."""


def judged(target: Target, content: bytes) -> list[str]:
    """``target(content)``. AssertionError if that takes longer than ``HANG_S``, or a refusal is not one line."""
    began = time.process_time()
    refused = target(content)
    took = time.process_time() - began
    if took > HANG_S:
        raise AssertionError(f'{took:.1f} s for one input')
    for text in refused:
        if '\n' in text:
            raise AssertionError(f'more than one line: {text!r}')
    return refused


def frames_target() -> tuple[Target, list[bytes]]:
    """The decoder: whole, and byte by byte, gives the same."""
    from psd_deflection.protocol.frames import (
        BadFrame,
        FrameDecoder,
        HelloFrame,
        PingFrame,
        SampleFrame,
        StatusFrame,
        encode,
    )

    def target(stream: bytes) -> list[str]:
        stream = stream[:4096]
        whole = FrameDecoder().feed(b'\x00' + stream)
        pieces = FrameDecoder()
        apart = pieces.feed(b'\x00')
        for i in range(len(stream)):
            apart += pieces.feed(stream[i : i + 1])
        # By text: NaN in a HELLO is not equal to itself.
        if repr(whole) != repr(apart):
            raise AssertionError(f'{apart} byte by byte, but {whole} whole')
        return [f.reason for f in whole if isinstance(f, BadFrame)]

    seeds = [
        encode(SampleFrame(0, 1, 1000, (1, 2, 3, 4, 5, 6))),
        encode(StatusFrame(3, None)),
        encode(HelloFrame(1, {'serial': 'A'})),
        encode(PingFrame(7)),
    ]
    return target, seeds


def _file_target(suffix: str, *steps: Callable[[Path], object]) -> Target:
    """Writes the input to a file, and reads that by each of ``steps``."""
    from psd_deflection.errors import PsdDeflectionError

    folder = Path(tempfile.mkdtemp(dir='/dev/shm' if Path('/dev/shm').is_dir() else None))
    path = folder / f'input{suffix}'

    def target(content: bytes) -> list[str]:
        path.write_bytes(content)
        refused = []
        for step in steps:
            try:
                step(path)
            except PsdDeflectionError as error:
                refused.append(str(error))
        path.with_name(path.name + '.cut').unlink(missing_ok=True)
        return refused

    return target


def bag_target() -> tuple[Target, list[bytes]]:
    """A lone ``.mcap``: everything that a command may ask of it; and ``recover``."""
    from psd_deflection.config import load_rig
    from psd_deflection.recordings.bag_writer import McapFile
    from psd_deflection.recordings.readers import open_recording
    from psd_deflection.recordings.repair import recover
    from psd_deflection.records import AppliedLoad

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
    """A CSV recording."""
    from psd_deflection.recordings.readers import open_recording

    seed = b't,x1,y1,sum1,x2,y2,sum2,load_fx,load_fy,load_tz\n'
    seed += b''.join(b'%d.%03d,0,1e-3,5,-1,2,5,1,0,0\n' % (i // 1000, i % 1000) for i in range(30))
    target = _file_target(
        '.csv',
        lambda path: list(open_recording(path).blocks()),
        lambda path: list(open_recording(path).loads()),
        lambda path: list(open_recording(path).references()),
        lambda path: list(open_recording(path).temperatures()),
    )
    return target, [seed]


def parameters_target() -> tuple[Target, list[bytes]]:
    """A parameter file, and the rig of it; the kept zero as well."""
    from psd_deflection.config import load_rig
    from psd_deflection.runner.zero_store import ZeroStore

    nominal = load_rig()

    def load_zero(path: Path) -> None:
        _, said = ZeroStore(load_rig(None, {'zero_file': str(path)}), 'A').load(nominal)
        if '\n' in said:
            raise AssertionError(f'more than one line: {said!r}')

    return _file_target('.yaml', load_rig, load_zero), [
        (ROOT / 'config' / 'thesis_rig.yaml').read_bytes(),
        b'{"configured": {"psd_1.zero": [0.0, 0.0]}, "psd_1.zero": [0, 0], "psd_2.zero": [0, 0]}',
        b'a: &a [*a, 1]\n/**:\n  ros__parameters: {link: {length: 1}}\n',
    ]


TARGETS: dict[str, Callable[[], tuple[Target, list[bytes]]]] = {
    'frames': frames_target,
    'bag': bag_target,
    'csv': csv_target,
    'parameters': parameters_target,
}
"""Each target with inputs to begin from, of which the first is whole."""


def corrupted(count: int) -> int:
    """Damage ``count`` sample frames; how many are accepted with another content than was sent."""
    from psd_deflection.protocol.frames import BadFrame, FrameDecoder, SampleFrame, encode

    chance = random.Random(1)
    originals = []
    for i in range(256):
        counts = tuple(chance.randrange(-32768, 32768) for _ in range(6))
        frame = SampleFrame(i & 3, chance.getrandbits(32), chance.getrandbits(40), counts)  # type: ignore[arg-type]
        originals.append((frame, encode(frame)))
    decoder = FrameDecoder()
    decoder.feed(b'\x00')
    wrong = same = refused = lost = 0
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
            refused += 1
        elif accepted == [frame]:
            same += 1
        elif any(type(f) is SampleFrame and f != frame for f in accepted):
            wrong += 1
            print(f'accepted with another content: {bytes(damaged).hex()}')
        else:
            lost += 1
    print(
        f'{count} damaged frames: {refused} refused, {same} came out as they were sent, '
        f'{lost} taken for another kind, {wrong} accepted with a wrong content (chance alone: {count * 2.0**-32:.4f})'
    )
    return 1 if wrong else 0


def main() -> int:
    """Fuzz one target until its time is over, or a fault is found."""
    if len(sys.argv) > 2 and sys.argv[1] == 'corrupted':
        return corrupted(int(sys.argv[2]))
    if len(sys.argv) < 2 or sys.argv[1] not in TARGETS:
        print(__doc__, file=sys.stderr)
        return 2
    import atheris

    name = sys.argv[1]
    with atheris.instrument_imports(include=['psd_deflection', 'msg_adapters', 'yaml']):
        target, seeds = TARGETS[name]()
    corpus = Path(tempfile.mkdtemp())
    for i, seed in enumerate(seeds):
        (corpus / f'seed_{i}').write_bytes(seed)
    found = ROOT / 'build' / 'fuzz'
    found.mkdir(parents=True, exist_ok=True)

    def one_input(content: bytes) -> None:
        judged(target, content)

    atheris.Setup([sys.argv[0], str(corpus), *LIMITS, f'-artifact_prefix={found}/{name}_', *sys.argv[2:]], one_input)
    atheris.Fuzz()
    return 0


if __name__ == '__main__':
    sys.exit(main())
