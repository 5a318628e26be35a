# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""``make campaign NAME=faults``: each fault injected again and again into the line of the real node."""

import contextlib
import os
import select
import signal
import sys
import tempfile
import threading
import time
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import serial
from cobs import cobs
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import PointCloud2

from bench.campaign.line import DIGIT, VOLTS_PER_COUNT, Line, hello_of, identities
from bench.campaign.plant import Spun
from blind.campaign import options
from psd_deflection.devices.protocol.frames import encode
from psd_deflection.recordings.read.readers import open_recording
from tools.program import PSD_DEFLECTION, Program

Act = Callable[[Line, int], None]  # What a fault does to the line, or to the node with that process id.


@dataclass(frozen=True, slots=True)
class Fault:
    """``act(line, pid)`` returns when the fault is over. ``observed``: diagnostics of which one must have risen.
    ``estimates``: what must come back is the estimate, not the sample. ``back``: the port was away, so the time to
    recover counts against the second that is allowed."""

    name: str
    act: Act
    observed: tuple[str, ...]
    estimates: bool = False
    back: bool = False


BAD, AWAY, STILL = ('bad frames',), ('disconnects',), ('rejected: frozen', 'found: psd_2 stands still')
STOLEN = 512  # Bytes: some of them were samples.


def _while(seconds: float, **attributes: object) -> Act:
    """The line has these attributes for that long."""

    def act(line: Line, pid: int) -> None:
        with line.lock:
            before = {name: getattr(line, name) for name in attributes}
            vars(line).update(attributes)
        time.sleep(seconds)
        with line.lock:
            vars(line).update(before)

    return act


def _changed(change: Callable[[Line, bytes], bytes | None], seconds: float) -> Act:
    """Each frame goes through ``change``; None leaves it as it is."""
    return lambda line, pid: _while(seconds, tamper=lambda identity, frame: change(line, frame))(line, pid)


def _once(change: Callable[[Line, bytes], bytes]) -> Act:
    def act(line: Line, pid: int) -> None:
        first = iter((change,))
        _changed(lambda line, frame: todo(line, frame) if (todo := next(first, None)) else None, 0.03)(line, pid)

    return act


def _injected(make: Callable[[Line], bytes], seconds: float = 0.03) -> Act:
    def act(line: Line, pid: int) -> None:
        line.inject(make(line))
        time.sleep(seconds)

    return act


def _merged(line: Line, frame: bytes) -> bytes:
    # The next frame is this one's tail: it is taken as well.
    line.taken_by_fault.add(line.sent)
    return frame[:-1]


def _flip(line: Line, frame: bytes) -> bytes:
    out = bytearray(frame)
    # Any bit but those of the closing zero; one that makes a new zero is welcome too.
    bit = line.random.randrange(8 * (len(out) - 1))
    out[bit // 8] ^= 1 << bit % 8
    return bytes(out)


def _flip_a_tenth(line: Line, frame: bytes) -> bytes | None:
    return _flip(line, frame) if line.random.random() < 0.1 else None


def _noise(line: Line) -> bytes:
    return b'\x00' + bytes(line.random.getrandbits(8) for _ in range(64)) + b'\x00'


def _sealed(payload: bytes) -> bytes:
    """A frame of any content, with the right CRC."""
    sealed: bytes = cobs.encode(payload + zlib.crc32(payload).to_bytes(4, 'little')) + b'\x00'
    return sealed


def _replugged(after_s: float = 0.1, names: tuple[str, str] | None = None, restart: bool = False) -> Act:
    """Unplugged for ``after_s``; then under its name, or under that of ``names`` which it had not."""

    def act(line: Line, pid: int) -> None:
        line.unplug()
        if restart:
            line.restart()
        time.sleep(after_s)
        line.plug(line.name if names is None else names[line.name == names[0]])

    return act


def _replugged_beside_another(line: Line, pid: int) -> None:
    old = line.name
    line.unplug()
    other = Line(line.folder, old)
    other.serial = 'SOMEBODY-ELSE'
    time.sleep(0.3)
    line.plug('port_c' if old != 'port_c' else 'port')

    def leave() -> None:
        line.greeted.wait(5.0)
        other.close()

    # The time to recover counts from here, with the other one still there.
    threading.Thread(target=leave, daemon=True).start()


def _held_by_another(line: Line, pid: int) -> None:
    line.unplug()
    line.plug(line.name)
    try:
        holder = serial.Serial(line.device_name, 921600, exclusive=True)
    except serial.SerialException:
        # The node was quicker: then nobody else can have it, which is the point.
        return
    time.sleep(0.4)
    holder.close()


def _stolen_bytes(line: Line, pid: int) -> None:
    first = line.wait_until_read()
    descriptor = os.open(line.device_name, os.O_RDONLY | os.O_NOCTTY | os.O_NONBLOCK)
    start, stolen = time.monotonic(), 0
    # On an idle machine the node is quicker, time and again: a thief that got nothing is no fault.
    while (passed := time.monotonic() - start) < 0.1 or (stolen < STOLEN and passed < 5.0):
        select.select((descriptor,), (), (), 0.01)
        with contextlib.suppress(BlockingIOError):
            stolen += len(os.read(descriptor, 64))
    os.close(descriptor)
    with line.lock:
        # Which of them it took only it knows: all that were sent meanwhile, and what was on its way.
        line.taken_by_fault.update(range(first, line.sent + 1))


def _wrong_baud(line: Line, pid: int) -> None:
    _changed(lambda line, frame: bytes(line.random.getrandbits(8) or 1 for _ in frame), 0.3)(line, pid)
    line.inject(b'\x00')


def _duplicates(line: Line, pid: int) -> None:
    frames: list[bytes] = []
    # append() returns None: the frames go on as they are.
    _changed(lambda line, frame: frames.append(frame), 0.03)(line, pid)
    line.inject(b''.join(frames[-30:]))
    time.sleep(0.02)


def _swapped(line: Line, pid: int) -> None:
    waiting: list[bytes] = []

    def tamper(identity: int, frame: bytes) -> bytes | None:
        waiting.append(frame)
        if len(waiting) == 2:
            with line.lock:
                line.taken_by_fault.discard(identity)
        return b'' if len(waiting) == 1 else None

    _while(0.02, tamper=tamper)(line, pid)
    line.inject(waiting[0] if waiting else b'')
    time.sleep(0.01)


def _jump(samples: int, us: int) -> Act:

    def act(line: Line, pid: int) -> None:
        line.jump(samples, us)
        time.sleep(0.05)

    return act


def _restart(seq: int = 0) -> Act:
    def act(line: Line, pid: int) -> None:
        line.restart(seq, 0)
        line.inject(encode(hello_of()))
        time.sleep(0.08)

    return act


def _overrun(line: Line, pid: int) -> None:
    with line.lock:
        # The first sample after the silence carries the flag.
        line.mute, line.flags = True, 2
    time.sleep(0.03)
    with line.lock:
        line.mute = False


def _stopped(line: Line, pid: int) -> None:
    with line.lock:
        line.mute = line.obedient = True
    deadline = time.monotonic() + 8.0
    while line.mute and time.monotonic() < deadline:
        time.sleep(0.01)


def _frozen_node(line: Line, pid: int) -> None:
    os.kill(pid, signal.SIGSTOP)
    time.sleep(0.3)
    os.kill(pid, signal.SIGCONT)


def _dark(channel: int, counts: int) -> Act:
    return _while(0.15, optics={channel: counts})


FAULTS: tuple[Fault, ...] = (
    Fault('unplugged, back under its name', _replugged(), AWAY, back=True),
    Fault('unplugged, back under another name', _replugged(names=('port', 'port_b')), AWAY, back=True),
    Fault('unplugged, another device on its port, back elsewhere', _replugged_beside_another, AWAY, back=True),
    Fault('unplugged for 1.5 s', _replugged(1.5), AWAY, back=True),
    Fault('unplugged and restarted', _replugged(restart=True), AWAY, back=True),
    Fault('back while another program has the port', _held_by_another, AWAY, back=True),
    Fault('another program reads from the port', _stolen_bytes, ('lost', 'bad frames')),
    Fault('wrong baud rate for 0.3 s', _wrong_baud, BAD),
    Fault('64 bytes of garbage', _injected(_noise), BAD),
    Fault('2000 bytes without an end', _injected(lambda line: b'\x55' * 2000 + b'\x00'), BAD),
    Fault('zeros and garbage', _injected(lambda line: b'\x00' * 200 + _noise(line)), BAD),
    Fault('frame truncated', _once(lambda line, f: f[: line.random.randrange(2, len(f) - 1)] + b'\x00'), BAD),
    Fault('frame without its closing zero', _once(_merged), BAD),
    Fault('frame split by a zero', _once(lambda line, f: f[:9] + b'\x00' + f[9:]), BAD),
    Fault('one bit flipped', _once(_flip), BAD),
    Fault('a tenth of the frames flipped for 0.2 s', _changed(_flip_a_tenth, 0.2), BAD),
    Fault('frame duplicated', _once(lambda line, f: f * 2), ('repeated',)),
    Fault('30 frames duplicated', _duplicates, ('repeated',)),
    Fault('frame late, out of order', _swapped, ('repeated', 'lost')),
    Fault('frame lost without a trace', _once(lambda line, f: b''), ('lost',)),
    Fault('numbers jump by 7', _jump(7, 7_000), ('lost',)),
    Fault('numbers jump by 100,000', _jump(100_000, 100_000_000), ('lost',)),
    Fault('device restarts', _restart(), ('device restarts',)),
    Fault('device restarts 50 before 2^32', _restart(2**32 - 50), ('device restarts',)),
    Fault('device clock jumps ahead 10 s', _jump(0, 10_000_000), ('device clock jumps',)),
    Fault('device clock jumps back 10 s', _jump(0, -10_000_000), ('device clock jumps', 'device restarts')),
    Fault('device overrun of 30 samples', _overrun, ('lost: dropped by the device',)),
    Fault('port stalled for 0.3 s', _while(0.3, hold=True), ()),
    Fault('port stalled for 1 s', _while(1.0, hold=True), ()),
    Fault('device silent for 2.4 s', _while(2.4, mute=True), ('silences',)),
    Fault('device stopped until it is woken', _stopped, ('silences',)),
    Fault('node stopped for 0.3 s (SIGSTOP)', _frozen_node, ()),
    Fault('unknown frame type', _injected(lambda line: _sealed(b'\x7fhello')), BAD),
    Fault('sample of a wrong length, right CRC', _injected(lambda line: _sealed(b'\x01' + b'\x00' * 11)), BAD),
    Fault('HELLO that is no JSON', _injected(lambda line: _sealed(b'\x10\x01{not json')), BAD),
    Fault('HELLO of another rate', lambda line, pid: line.inject(encode(hello_of(rate=500.0))), ()),
    Fault('laser 1 off', _dark(2, 3), ('rejected: laser_lost',), estimates=True),
    Fault('laser 2 off', _dark(5, -2), ('rejected: laser_lost',), estimates=True),
    Fault('y1 saturated', _while(0.15, optics={1: 32767}), ('rejected: saturated',), estimates=True),
    Fault('psd_2 stands still', _while(0.25, freeze=True), (*STILL,), estimates=True),
)
START_S, RECOVER_S = 300.0, 5.0
BACK_S = 1.0  # A device that is back is read again within this.


@dataclass(slots=True)
class Row:
    fault: Fault
    injected: int = 0
    detected: int = 0
    recovered: int = 0
    times: list[float] = field(default_factory=list)
    windows: list[tuple[int, int]] = field(default_factory=list)


class Witness(Spun):
    """Another participant: newest identity and estimate, and the counters of the last report."""

    def __init__(self) -> None:
        super().__init__('campaign')
        self.newest = -1
        self.estimates = 0
        self.reports = 0
        self.counters: dict[str, float] = {}
        self.node.create_subscription(PointCloud2, '/psd/samples', self._cloud, 50)
        self.node.create_subscription(PoseStamped, '/link_tip/deflection', self._pose, 50)
        self.node.create_subscription(DiagnosticArray, '/diagnostics', self._report, 10)

    def _cloud(self, cloud: PointCloud2) -> None:
        names = [f.name for f in cloud.fields]
        points = np.frombuffer(bytes(cloud.data), np.dtype('<u4')).reshape(-1, len(names))[-1]
        low = np.rint(points[names.index('x1')].view('<f4') / VOLTS_PER_COUNT) + DIGIT // 2
        high = np.rint(points[names.index('x2')].view('<f4') / VOLTS_PER_COUNT) + DIGIT // 2
        self.newest = max(self.newest, int(low + high * DIGIT))

    def _pose(self, pose: PoseStamped) -> None:
        self.estimates += 1

    def _report(self, report: DiagnosticArray) -> None:
        values = [value for status in report.status for value in status.values]
        self.counters = {v.key: float(v.value) for v in values if v.value.lstrip('-').isdigit()}
        self.reports += 1

    def next_report(self) -> dict[str, float]:
        observed = self.reports
        self.spin(5.0, lambda: self.reports > observed)
        return self.counters


def inject(row: Row, line: Line, witness: Witness, pid: int) -> None:
    fault = row.fault
    before = witness.counters
    first = line.next_identity()
    row.injected += 1
    fault.act(line, pid)
    over, target, estimates = time.monotonic(), line.next_identity(), witness.estimates
    if fault.estimates:
        # What was under way when the fault ended is no sign of recovery: a whole block later is.
        witness.spin(RECOVER_S, lambda: witness.newest >= target + 20)
        estimates = witness.estimates
        recovered = witness.spin(RECOVER_S, lambda: witness.estimates > estimates)
    else:
        recovered = witness.spin(RECOVER_S, lambda: witness.newest >= target)
    took = time.monotonic() - over
    row.recovered += recovered
    row.times.append(took)
    row.windows.append((first, line.next_identity()))
    after = witness.next_report()
    row.detected += not fault.observed or any(after.get(k, 0.0) > before.get(k, 0.0) for k in fault.observed)


def lost_samples(rows: list[Row], line: Line, recording: Path, start: int, end: int) -> dict[str, tuple[int, int]]:
    """Fault name -> (samples that arrived whole and are not in the recording, samples the fault took)."""
    present: set[int] = set()
    for block in open_recording(recording).blocks():
        present.update(identities(block.volts).tolist())
    out = {}
    accounted: set[int] = set()
    for row in rows:
        numbers = {i for a, b in row.windows for i in range(a, b)}
        accounted |= numbers
        taken = numbers & line.taken_by_fault
        # The optics change the digits themselves.
        out[row.fault.name] = (0 if row.fault.estimates else len(numbers - taken - present), len(taken))
    rest = set(range(start, end)) - accounted - line.taken_by_fault - present
    out['between the faults'] = (len(rest), 0)
    for first in sorted(i for i in rest if i - 1 not in rest):
        last = next(i for i in range(first, end + 1) if i + 1 not in rest)
        before = max(((b, row.fault.name) for row in rows for _, b in row.windows if b <= first), default=(0, 'start'))
        print(f'missing: {first} to {last}, {first - before[0]} samples after "{before[1]}" was over', file=sys.stderr)
    return out


def report(rows: list[Row], lost: dict[str, tuple[int, int]]) -> bool:
    head = f'{"fault":52} {"times":>5} {"detected":>8} {"recovered":>9} {"median s":>8} {"worst s":>8}'
    print(f'{head} {"taken":>7} {"lost":>5}')
    good = True
    for row in rows:
        missing, taken = lost[row.fault.name]
        worst = max(row.times)
        detected = str(row.detected) if row.fault.observed else '-'
        fine = row.recovered == row.injected == row.detected and missing == 0
        fine = fine and (not row.fault.back or worst <= BACK_S)
        good = good and fine
        figures = f'{row.injected:5d} {detected:>8} {row.recovered:9d} {np.median(row.times):8.3f} {worst:8.3f}'
        wrong = '' if fine else '  <-- NOT AS IT MUST BE'
        print(f'{row.fault.name:52} {figures} {taken:7d} {missing:5d}{wrong}')
    between = lost['between the faults'][0]
    print(f'{"between the faults":52} {"":40} {"":7} {between:5d}')
    return good and between == 0


def main() -> int:
    parser = options(__doc__)
    parser.add_argument('--times', type=int, default=20, help='injections of each fault')
    parser.add_argument('--only', default='', help='only faults whose name holds this')
    args = parser.parse_args()
    chosen = [f for f in FAULTS if args.only in f.name]
    os.environ.setdefault('ROS_DOMAIN_ID', '77')
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        os.environ['XDG_STATE_HOME'] = os.environ['ROS_LOG_DIR'] = str(folder)
        line = Line(folder)
        arguments = ['--port', f'{folder}/port*', '--record', str(folder / 'bags')]
        node = Program([*PSD_DEFLECTION, 'estimator', *arguments])
        witness = Witness()
        rows = [Row(f) for f in chosen]
        try:
            if not witness.spin(START_S, lambda: witness.newest > 2000 and witness.reports > 2):
                raise SystemExit(node.text)
            start = line.next_identity()
            for number in range(args.times):
                for row in rows:
                    inject(row, line, witness, node.process.pid)
                print(f'round {number + 1} of {args.times}', file=sys.stderr, flush=True)
            end = line.next_identity()
            witness.spin(10.0, lambda: witness.newest > end + 100)
            counters = witness.next_report()
            print({k: v for k, v in counters.items() if 'drop' in k or 'lost' in k or k == 'disconnects'})
        finally:
            node.end()
            line.close()
        (recording,) = (folder / 'bags').iterdir()
        good = report(rows, lost_samples(rows, line, recording, start, end))
        if not good:
            print(node.text[-6000:], file=sys.stderr)
    witness.close()
    return 0 if good else 1


if __name__ == '__main__':
    sys.exit(main())
