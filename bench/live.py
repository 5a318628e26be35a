# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""``make bench``, the live path: its cost beside the minimum that ROS and MCAP allow."""

import argparse
import asyncio
import contextlib
import itertools
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Self

import numpy as np
import numpy.typing as npt

from bench.rows import BY_HAND, ROOT, Row, figure, keep, piped

BLOCKS_PER_S = 50
START_S = 4.0  # A process has imported rclpy and found the others.


def until_stdin_closes() -> threading.Event:
    """An event that is set when the parent closes our standard input."""
    stop = threading.Event()

    def wait() -> None:
        sys.stdin.read()
        stop.set()

    threading.Thread(target=wait, daemon=True).start()
    return stop


def subscriber() -> None:
    """Child process: prints, for each message, topic, stamp and the monotonic time of its callback."""
    import rclpy
    from geometry_msgs.msg import PoseStamped

    rclpy.init()
    node = rclpy.create_node('bench_subscriber')
    rows: list[tuple[str, int, int]] = []

    def listen(topic: str) -> None:
        def received(message: PoseStamped) -> None:
            stamp = message.header.stamp
            rows.append((topic, stamp.sec * 10**9 + stamp.nanosec, time.monotonic_ns()))

        node.create_subscription(PoseStamped, topic, received, 50)

    listen('/link_tip/deflection')
    listen('/bare')
    stop, ready = until_stdin_closes(), False
    while not stop.is_set():
        rclpy.spin_once(node, timeout_sec=0.1)
        # Publisher and subscriber must discover each other before anything can be measured.
        if not ready and len({topic for topic, *_ in rows}) == 2:
            ready = True
            print('ready', flush=True)
    json.dump(rows, sys.stdout)


def bare_publisher() -> None:
    """Child process: the same message at the same rate with nothing around it; prints when it published."""
    import rclpy
    from geometry_msgs.msg import PoseStamped

    rclpy.init()
    node = rclpy.create_node('bench_bare')
    publisher = node.create_publisher(PoseStamped, '/bare', 10)
    message = PoseStamped()
    message.header.frame_id = 'link_tip_rest'
    print('ready', flush=True)
    stop = until_stdin_closes()
    rows: list[tuple[int, int]] = []
    count = 0
    while not stop.wait(0.02):
        count += 1
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(count, 10**9)
        now = time.monotonic_ns()
        publisher.publish(message)
        rows.append((count, now))
    json.dump(rows, sys.stdout)


def looker(url: str) -> None:
    """Child process: receives the live page's data like a browser; prints the number of blocks in it."""
    import aiohttp

    stop = until_stdin_closes()

    async def look() -> int:
        message: list[str] = []
        async with aiohttp.ClientSession() as session, session.ws_connect(f'{url}ws') as socket:
            print('ready', flush=True)
            while not stop.is_set():
                message.append(await socket.receive_str())
        return sum(len(json.loads(text).get('rows', ())) for text in message)

    print(asyncio.run(look()))


def notify_share(seconds: float, step: Callable[[], object]) -> None:
    """Prints the share of a core that this process takes, in percent, if it does ``step`` once a block."""
    end, before = time.monotonic() + seconds, time.process_time()
    next_time = time.monotonic()
    while next_time < end:
        step()
        next_time += 1.0 / BLOCKS_PER_S
        time.sleep(max(next_time - time.monotonic(), 0.0))
    print(100.0 * (time.process_time() - before) / seconds)


def bare_reader(port: str, seconds: float) -> None:
    """Child process: reads the port and does nothing with it."""
    fd = os.open(port, os.O_RDONLY | os.O_NOCTTY)
    notify_share(seconds, lambda: os.read(fd, 4096))


def blocks_of(recording: str) -> Iterator[list[tuple[str, str, bytes]]]:
    """For ever: the messages of one block after the other, as topic, type and bytes."""
    from mcap.reader import make_reader

    blocks: dict[int, list[tuple[str, str, bytes]]] = {}
    with next(Path(recording).glob('*.mcap')).open('rb') as file:
        for schema, channel, message in make_reader(file).iter_messages():
            if schema is not None:
                blocks.setdefault(message.log_time // 20_000_000, []).append((channel.topic, schema.name, message.data))
    return itertools.cycle(blocks.values())


def bare_publishers(recording: str, seconds: float) -> None:
    """Child process: publishes the messages of each block, which are encoded already."""
    import rclpy

    from psd_deflection.ros.endpoints import message_class

    rclpy.init()
    node, blocks = rclpy.create_node('bench_publishers'), blocks_of(recording)
    publishers = {topic: node.create_publisher(message_class(kind), topic, 10) for topic, kind, _ in next(blocks)}

    def step() -> None:
        for topic, _, data in next(blocks):
            if topic in publishers:
                publishers[topic].publish(data)

    notify_share(seconds, step)


def bare_writer(recording: str, seconds: float) -> None:
    """Child process: writes the messages of each block into an MCAP file."""
    from mcap.writer import CompressionType, Writer

    blocks = blocks_of(recording)
    with tempfile.TemporaryFile() as file:
        writer = Writer(file, compression=CompressionType.ZSTD)
        writer.start()
        channels: dict[str, int] = {}

        def step() -> None:
            now = time.time_ns()
            for topic, kind, data in next(blocks):
                if topic not in channels:
                    schema = writer.register_schema(kind, 'ros2msg', b'')
                    channels[topic] = writer.register_channel(topic, 'cdr', schema)
                writer.add_message(channels[topic], now, data, now)

        notify_share(seconds, step)


def parts(seconds: float, times: int) -> list[float]:
    """Reading the port, publishing and writing the same messages, each alone: the sum of their CPU, % of a core."""
    sums = []
    with tempfile.TemporaryDirectory() as folder:
        recording = str(make_recording(Path(folder), 0.1)[0])
        for _ in range(times):
            with Device() as device:
                each = (('reader', device.port.name), ('publishers', recording), ('writer', recording))
                sums.append(sum(float(child(role, what, seconds).communicate()[0]) for role, what in each))
    return sums


class Device:
    """Writes samples to a port by the clock; ``written``: when it began to write the last byte of each block, ns."""

    def __init__(self) -> None:
        from psd_deflection.devices.contract_frames import SimulatedFrames
        from psd_deflection.devices.pseudo_terminal import PseudoTerminal
        from psd_deflection.devices.rig_feed import RigFeed
        from psd_deflection.rig.config import load_rig

        self.port = PseudoTerminal()
        self.device = SimulatedFrames(RigFeed(load_rig(), lambda _, n: np.zeros((n, 3))))
        self.written: list[int] = []
        self.stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop.set()
        self._thread.join()

    def _run(self) -> None:
        start = time.monotonic_ns()
        while not self.stop.is_set():
            time.sleep(max(self.device.due_in_ns(time.monotonic_ns() - start), 0) / 1e9)
            before = self.device.taken
            stream = self.device.take(time.monotonic_ns() - start)
            try:
                asked = os.read(self.port.master, 4096)
            except OSError:
                asked = b''
            now = time.monotonic_ns()
            try:
                os.write(self.port.master, self.device.receive(asked, 0) + stream)
            except OSError:
                continue
            ended = self.device.taken // 20 - before // 20
            self.written += [now] * ended


def child(role: str, what: str = '', seconds: float = 0.0) -> subprocess.Popen[str]:
    return piped('bench.live', '--role', role, '--of', what, '--seconds', str(seconds))


def cpu_seconds(pid: int) -> float:
    """User and system time of a process and all its threads, s."""
    fields = Path(f'/proc/{pid}/stat').read_text().rsplit(')', 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf('SC_CLK_TCK')


@dataclass(slots=True)
class Latencies:
    """What was measured of one kind of node, ms, and its share of a core while it ran."""

    ours: list[float] = field(default_factory=list)
    bare: list[float] = field(default_factory=list)
    shares: list[float] = field(default_factory=list)


@contextlib.contextmanager
def node(port: str, *options: str, page: bool = False) -> Iterator[tuple[int, str]]:
    """The node on ``port``: its process, and its address if it serves the live ``page`` too, on a port that is free."""
    more = ['--monitor', '--ros-args', '-p', 'monitor_port:=0'] if page else []
    command = [sys.executable, '-m', 'psd_deflection', 'estimator', '--port', port, *options, *more]
    process = subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None
    url = next(line.split()[1] for line in process.stderr if line.startswith('monitor: ')) if page else ''
    # Its further output is read and ignored.
    threading.Thread(target=process.stderr.read, daemon=True).start()
    try:
        yield process.pid, url
    finally:
        process.terminate()
        process.wait(60.0)


def until_ready(*children: subprocess.Popen[str]) -> None:
    for process in children:
        assert process.stdout is not None
        process.stdout.readline()


def measure(seconds: float, settle: float, page: bool, into: Latencies) -> None:
    """One node, recording; ``page``: it serves the live page too, and a browser's worth of it is fetched."""
    with (
        Device() as device,
        tempfile.TemporaryDirectory() as folder,
        node(device.port.name, '--record', folder, page=page) as (pid, url),
    ):
        children = [child('subscriber'), child('bare'), *([child('looker', url)] if page else [])]
        subscriber, bare = children[:2]
        until_ready(*children)
        time.sleep(settle)
        used, began = cpu_seconds(pid), time.monotonic()
        time.sleep(seconds)
        into.shares.append((cpu_seconds(pid) - used) / (time.monotonic() - began))
        published, _ = bare.communicate()
        heard, _ = subscriber.communicate()
        if page:
            reported, _ = children[2].communicate()
            # Even on a busy machine every block must arrive; up to half of them may still be under way.
            if int(reported) < 0.5 * BLOCKS_PER_S * seconds:
                raise SystemExit(f'the page told of {reported} blocks in {seconds:g} s')
    since, sent = int(began * 1e9), dict(json.loads(published))
    written = np.array(device.written)
    for topic, s, t in json.loads(heard):
        if t <= since:
            continue
        if topic == '/bare' and s in sent:
            into.bare.append((t - sent[s]) / 1e6)
        elif topic == '/link_tip/deflection':
            last = written[: int(np.searchsorted(written, t))]
            into.ours.append((t - int(last[-1])) / 1e6)


def live(seconds: float, settle: float, rounds: int) -> list[Row]:
    """The node alone and the node with the live page, in turns, each beside a bare publisher."""
    alone, with_page = Latencies(), Latencies()
    for _ in range(rounds):
        measure(seconds / rounds, settle, False, alone)
        measure(seconds / rounds, settle, True, with_page)
    return live_rows(alone, with_page, parts(seconds / rounds, rounds))


def make_recording(folder: Path, minutes: float) -> tuple[Path, int]:
    """Ten minutes as the daemon would have recorded them, without waiting for them."""
    from psd_deflection.measure.pipeline import Pipeline
    from psd_deflection.model.simulation.loads import CyclicLoads, thesis_load_cases
    from psd_deflection.model.simulation.simulator import RigSimulator
    from psd_deflection.recordings.write.bag_writer import BagWriter
    from psd_deflection.records import RawChunk
    from psd_deflection.rig.config import load_rig

    rig = load_rig()
    pipeline, simulator = Pipeline(rig), RigSimulator(rig, 1)
    loads = CyclicLoads(thesis_load_cases())
    path = folder / 'ten_minutes'
    n, step = round(minutes * 60_000), 2000
    with BagWriter(path, rig_values=dict(rig.values)) as bag:
        for first in range(0, n, step):
            counts: npt.NDArray[np.int32] = simulator.step(loads.take(step)).counts
            seq, flags = np.arange(first, first + step), np.zeros(step, np.uint8)
            chunk = RawChunk(seq, seq * 1_000_000 + 10**18, counts, flags, rig.converter.volts_per_count)
            for record in pipeline.process(chunk):
                bag.put(record)
    return path, n


def start(times: int) -> Row:
    """From the command to the first callback in a process that listens already; the limit is a bare publisher's."""
    seconds: dict[str, list[float]] = {'/link_tip/deflection': [], '/bare': []}
    for _ in range(times):
        with Device() as device:
            subscriber = child('subscriber')
            # Its own discovery is over before the others begin.
            time.sleep(START_S)
            began = {'/bare': time.monotonic_ns()}
            bare = child('bare')
            time.sleep(START_S)
            began['/link_tip/deflection'] = time.monotonic_ns()
            with node(device.port.name):
                # It says so once it has heard both.
                until_ready(subscriber)
                bare.communicate()
                heard, _ = subscriber.communicate()
        for topic, durations in seconds.items():
            first = min(t for name, _, t in json.loads(heard) if name == topic)
            durations.append((first - began[topic]) / 1e9)
    ours = figure('psd_deflection estimator', 'ours', seconds['/link_tip/deflection'])
    limit = figure('import rclpy, a bare publisher, DDS discovery', 'limit', seconds['/bare'], 1.2)
    return Row('start: command to first published estimate', 's', [ours, limit])


def live_rows(alone: Latencies, with_page: Latencies, bare_parts: list[float]) -> list[Row]:
    rows = []
    both = (('', alone, (1.4, 1.2), 1.25), (', live page looked at', with_page, (None, None), 1.5))
    for what, latencies, bounds, most in both:
        for word, percent, parts, bound in (('median', 50, 10, bounds[0]), ('99th percentile', 99, 3, bounds[1])):
            # In parts of the run, so that there is a spread.
            ours, bare = (
                [float(np.percentile(part, percent)) for part in np.array_split(values, parts)]
                for values in (latencies.ours, latencies.bare)
            )
            work = f'live{what}: last byte of a block to callback in another process, {word}'
            limit = figure('bare rclpy publish to callback', 'limit', bare, bound)
            rows.append(Row(work, 'ms', [figure('psd_deflection', 'ours', ours), limit]))
        shares = figure('node', 'ours', [100 * share for share in latencies.shares])
        limit = figure('reading the port, publishing, writing, each bare and alone', 'limit', bare_parts, most)
        rows.append(Row(f'live{what}: CPU of the node, recording', '% of a core', [shares, limit]))
    return rows


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--seconds', type=float, default=30.0, help='of the live measurement of each kind of node')
    parser.add_argument('--starts', type=int, default=5, help='times that the start is measured; 0: not at all')
    parser.add_argument('--results', type=Path, default=BY_HAND / 'results.json')
    parser.add_argument('--settle', type=float, default=5.0, help='seconds before each measurement')
    parser.add_argument('--rounds', type=int, default=2, help='in which it is done, so that a busy moment meets both')
    roles: dict[str, Callable[[], None]] = {
        'subscriber': subscriber,
        'bare': bare_publisher,
        'looker': lambda: looker(args.of),
        'reader': lambda: bare_reader(args.of, args.seconds),
        'publishers': lambda: bare_publishers(args.of, args.seconds),
        'writer': lambda: bare_writer(args.of, args.seconds),
    }
    parser.add_argument('--role', choices=tuple(roles), help=argparse.SUPPRESS)
    parser.add_argument('--of', help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.role:
        roles[args.role]()
    else:
        rows = live(args.seconds, args.settle, args.rounds)
        keep([*rows, start(args.starts)] if args.starts else rows, args.results)
    return 0


if __name__ == '__main__':
    sys.exit(main())
