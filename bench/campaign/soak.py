# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""``make campaign NAME=soak``: the daemon for long, in real time and in simulated time."""

import contextlib
import math
import os
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np

from bench.campaign.line import hello_of
from blind.campaign import options
from psd_deflection.base.log import texts
from psd_deflection.devices.contract_frames import SimulatedFrames
from psd_deflection.devices.device import PowerUp
from psd_deflection.devices.protocol import frames as protocol
from psd_deflection.devices.pseudo_terminal import PseudoTerminal
from psd_deflection.devices.rig_feed import RigFeed
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.recordings.read.readers import open_recording
from psd_deflection.rig.config import load_rig
from psd_deflection.run.acquisition import Acquisition
from psd_deflection.run.arrivals import Arrival
from tools.program import PSD_DEFLECTION, Program

SKEW, MS, START_S = 30e-6, 1_000_000, 300.0
SETTLED_S, ALLOWED_STD_NS, ALLOWED_GROWTH = 180, 50_000, 2_000_000


def resident(pid: int) -> int:
    return int(Path(f'/proc/{pid}/statm').read_text().split()[1]) * os.sysconf('SC_PAGE_SIZE')


class PolledDevice:
    """1 kHz by a clock that runs ``SKEW`` fast, over a line that takes its bytes each full millisecond."""

    def __init__(self, folder: Path) -> None:
        self.port = PseudoTerminal(folder / 'port')
        feed = RigFeed(load_rig(), lambda _, n: np.zeros((n, 3)))
        self._device = SimulatedFrames(feed, PowerUp(1e6 * SKEW, 0), serial='SOAK')
        self.start_ns = time.monotonic_ns()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def true_ns(self, number: int) -> int:
        """Host time (CLOCK_MONOTONIC) at which a sample was taken."""
        return self.start_ns + round(number * MS / (1.0 + SKEW))

    def _run(self) -> None:
        pending, heard = b'', False
        while not self._stop.is_set():
            now = time.monotonic_ns()
            time.sleep((MS - now % MS) / 1e9)
            now = time.monotonic_ns()
            # However late this thread is, the device drops nothing.
            asked, stream = b'', self._device.take(now - now % MS - self.start_ns, 1 << 20)
            with contextlib.suppress(BlockingIOError, OSError):
                asked = os.read(self.port.master, 4096)
            heard = heard or asked != b''
            # Nobody gets what was sent before it listened.
            pending = pending + self._device.receive(asked, now - self.start_ns) + stream if heard else b''
            with contextlib.suppress(BlockingIOError, OSError):
                pending = pending[os.write(self.port.master, pending) :]

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        self.port.close()


class RunningDeviation:
    """Mean and standard deviation of whole numbers, ns, of which none is kept."""

    def __init__(self) -> None:
        self.count = self.total = self.squares = 0

    def add(self, value: int) -> None:
        self.count += 1
        self.total += value
        self.squares += value * value

    @property
    def mean(self) -> float:
        return self.total / self.count if self.count else math.nan

    @property
    def std(self) -> float:
        # Whole numbers to the end: the squares of a day would cancel in floating point.
        square = self.count * self.squares - self.total**2
        return math.sqrt(square) / self.count if self.count else math.nan


def evaluated(name: str, lost: int, growth: int, errors: RunningDeviation) -> bool:
    good = lost == 0 and growth < ALLOWED_GROWTH and (not errors.count or errors.std <= ALLOWED_STD_NS)
    print(f'{name}: {lost} samples lost, memory {growth / 1e6:+.2f} MB after warm-up (allowed 2),', end=' ')
    words = f'{errors.mean / 1e3:+.1f} us on average, std {errors.std / 1e3:.1f} us (allowed 50)'
    print(f'stamps after {SETTLED_S} s: {words}' + ('' if good else '  <-- NOT AS IT MUST BE'), flush=True)
    return good


def real_time(minutes: float) -> bool:
    from geometry_msgs.msg import PoseStamped

    from bench.campaign.plant import Spun

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        os.environ.setdefault('ROS_DOMAIN_ID', '78')
        os.environ['XDG_STATE_HOME'] = os.environ['ROS_LOG_DIR'] = name
        device = PolledDevice(folder)
        arguments = ['--port', f'{folder}/port', '--record', str(folder / 'bags')]
        node = Program([*PSD_DEFLECTION, 'estimator', *arguments])
        witness = Spun('soak')
        poses = [0]

        def received(pose: PoseStamped) -> None:
            poses[0] += 1

        witness.node.create_subscription(PoseStamped, '/link_tip/deflection', received, 50)
        memory: list[tuple[float, int]] = []
        warm_up = min(60.0, 20.0 * minutes)
        try:
            witness.spin(START_S, lambda: poses[0] > 0 or node.process.poll() is not None)
            if not poses[0]:
                raise SystemExit(node.text)
            began = time.monotonic()
            while (passed := time.monotonic() - began) < minutes * 60.0 and node.process.poll() is None:
                witness.executor.spin_once(timeout_sec=0.5)
                if passed > warm_up and (not memory or passed - memory[-1][0] > 5.0):
                    memory.append((passed, resident(node.process.pid)))
        finally:
            node.end()
            device.close()
        witness.close()
        (bag,) = (folder / 'bags').iterdir()
        blocks = list(open_recording(bag).blocks())
        numbers, stamps = (np.concatenate([getattr(b, name) for b in blocks]) for name in ('seq', 't_ns'))
        lost = int(numbers[-1] - numbers[0]) + 1 - len(numbers)
        # Recorded times are ROS times; the offset to CLOCK_MONOTONIC is one constant of the run.
        offset = time.time_ns() - time.monotonic_ns()
        truth = np.array([device.true_ns(int(n)) for n in numbers]) + offset
        steady = stamps - stamps[0] > SETTLED_S * 10**9
        growth = memory[-1][1] - memory[0][1] if memory else 0
        print(f'{minutes:g} minutes: {len(numbers)} samples recorded, {poses[0]} poses received by a subscriber')
        errors = RunningDeviation()
        for error in (stamps - truth)[steady].tolist():
            errors.add(error)
        return evaluated('real time', lost, growth, errors)


def simulated_time(hours: float) -> bool:
    rig = load_rig(None, {'port': 'simulated', 'realtime': False, 'queue_blocks': 100_000})
    acquisition = Acquisition(rig, texts(lambda text: print(f'  said: {text}')))
    pipeline, decoder = Pipeline(rig), protocol.FrameDecoder()
    decoder.feed(b'\x00')
    rng = np.random.default_rng(4)
    once_a_second = protocol.encode(hello_of('SOAK')) + protocol.encode(protocol.StatusFrame(0, 2150))
    samples = int(hours * 3600) * 1000
    # The numbers wrap half way; blocks are cut at multiples of 20, and 2^32 is none.
    first = (2**32 - samples // 2) // 20 * 20
    errors = RunningDeviation()
    memory: list[int] = []
    blocks = present = 0
    began = time.perf_counter()
    for second in range(0, samples, 1000):
        numbers = first + second + np.arange(1000)
        counts = rng.integers(-13, 14, (1000, 6))
        counts[:, [2, 5]] += 16384
        pairs = zip(numbers.tolist(), counts.tolist(), strict=True)
        encoded = [protocol.encode(protocol.SampleFrame(0, n % 2**32, n * 1000, tuple(c))) for n, c in pairs]
        late = rng.exponential(50_000, 50).astype(np.int64).tolist()
        for number, read in enumerate(late):
            true_last = round((second + 20 * number + 19) * MS / (1.0 + SKEW))
            arrival = -(-true_last // MS) * MS + 200_000 + read
            piece = b''.join(encoded[20 * number : 20 * number + 20])
            acquisition.feed(decoder.feed(piece + (once_a_second if number == 0 else b'')), arrival)
            while not acquisition.queue.empty():
                item = acquisition.queue.get()
                if isinstance(item, Arrival):
                    blocks += 1
                    present += len(item.raw.seq)
                    for _ in pipeline.process(item.raw):
                        pass
                    if second >= SETTLED_S * 1000:
                        errors.add(int(item.raw.t_ns[-1]) - acquisition.to_ros_ns - true_last)
        if second % 600_000 == 0:
            memory.append(resident(os.getpid()))
        if second % 7_200_000 == 0:
            print(f'  {second // 3_600_000} h', file=sys.stderr, flush=True)
    seconds = time.perf_counter() - began
    speed = f'{seconds:.0f} s ({hours * 3600 / seconds:.0f} times real time)'
    print(f'{hours:g} h of simulated time in {speed}: {present} samples, {blocks} blocks,', end=' ')
    print(f'{pipeline.counters.estimates} estimates, numbers wrapped past 2^32')
    growth = memory[-1] - memory[min(2, len(memory) - 1)]
    return evaluated('simulated time', samples - present, growth, errors)


def main() -> int:
    parser = options(__doc__)
    parser.add_argument('--minutes', type=float, default=30.0)
    parser.add_argument('--hours', type=float, default=24.0)
    args = parser.parse_args()
    good = not args.minutes or real_time(args.minutes)
    return 0 if (not args.hours or simulated_time(args.hours)) and good else 1


if __name__ == '__main__':
    sys.exit(main())
