# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Two rigs in one process, and the end effector composed of them."""

import queue
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from psd_deflection.arms.chains.chain import PATIENCE, Chain, EndEffector
from psd_deflection.arms.chains.chain_file import ChainFile, read_chain
from psd_deflection.base.errors import DeviceError
from psd_deflection.base.log import null_log, texts
from psd_deflection.devices.protocol.frames import SampleFrame
from psd_deflection.run.chain import ChainSession, Composed
from test.heard import WAIT_S
from test.run.conftest import ScriptedDevice

Sample = Callable[..., SampleFrame]
CHAIN = """
links:
  - {name: upper, port: PORT_0, joint: {name: shoulder, axis: [0, 1, 0]}}
  - {name: fore, port: PORT_1}
end_effector: {xyz: [0, 0, 0.1]}
"""


@pytest.fixture
def devices(tmp_path: Path) -> Iterator[list[ScriptedDevice]]:
    both = [ScriptedDevice(tmp_path / f'port_{n}') for n in range(2)]
    yield both
    for device in both:
        if device.plugged:
            device.unplug()


@pytest.fixture
def file(devices: list[ScriptedDevice], tmp_path: Path) -> ChainFile:
    text = CHAIN
    for n, device in enumerate(devices):
        text = text.replace(f'PORT_{n}', str(device.link))
    (tmp_path / 'chain.yaml').write_text(text)
    given = {'keep_zero': False, 'realtime': False, 'bag_dir': str(tmp_path / 'recordings')}
    return read_chain(tmp_path / 'chain.yaml', given)


class Running:
    """A chain whose devices have sent ``count`` samples each; ``composed``: what came of them."""

    def __init__(self, file: ChainFile) -> None:
        self.logged: queue.SimpleQueue[str] = queue.SimpleQueue()
        self.chain = ChainSession(file, texts(self.logged.put))
        self.composed: queue.SimpleQueue[Composed] = queue.SimpleQueue()
        self.chain.listeners.append(self.composed.put)
        self.chain.start()
        self.sent = 0

    def send(self, devices: list[ScriptedDevice], sample: Sample, count: int) -> None:
        for device in devices:
            device.send_frames(*(sample(self.sent + n) for n in range(count)))
        self.sent += count

    def heard(self, text: str) -> None:
        while text not in self.logged.get(timeout=WAIT_S):
            pass

    def until(self, wanted: Callable[[Composed], bool]) -> Composed:
        while not wanted(composed := self.composed.get(timeout=WAIT_S)):
            pass
        return composed


@pytest.fixture
def running(file: ChainFile, devices: list[ScriptedDevice], sample: Sample) -> Iterator[Running]:
    run = Running(file)
    run.send(devices, sample, 200)
    yield run
    run.chain.close()


def test_the_end_effector_is_composed_of_both(running: Running) -> None:
    composed = running.until(lambda c: c.end is not None)
    assert composed.end is not None
    assert np.abs(composed.end.vector).max() < 1e-9
    record = composed.as_record()
    assert record is not None
    assert record.t_ns == composed.t_ns
    assert len(record.covariance) == 36
    first, second = (session.acquisition.to_ros_ns for session in running.chain.sessions)
    assert first == second


def test_one_end_effector_is_composed_at_a_time(running: Running, file: ChainFile) -> None:
    running.until(lambda c: c.end is not None)
    first = running.chain.sessions[0].pipeline.last_estimate
    running.chain.close()
    assert first is not None
    second = first._replace(t_ns=first.t_ns + 20_000_000)
    chain = ChainSession(file, null_log)
    inside, go_on, composed = threading.Event(), threading.Event(), []

    def listener(message: Composed) -> None:
        composed.append(message.t_ns)
        inside.set()
        go_on.wait(WAIT_S)

    chain.listeners.append(listener)
    threads = [threading.Thread(target=chain.take, args=(link, e)) for e in (first, second) for link in (0, 1)]
    for thread in threads[:2]:
        thread.start()
    assert inside.wait(WAIT_S)
    for thread in threads[2:]:
        thread.start()
    # Neither is taken while the first is composed.
    threads[2].join(0.2)
    assert threads[2].is_alive()
    go_on.set()
    for thread in threads:
        thread.join(WAIT_S)
    chain.close()
    assert composed == [first.t_ns, second.t_ns]


def test_a_link_that_is_away_is_missing_and_named(running: Running, devices: list[ScriptedDevice]) -> None:
    last = running.until(lambda c: c.end is not None)
    devices[1].unplug()
    running.heard('waiting for it to come back')
    upper = running.chain.sessions[0].pipeline.last_estimate
    assert upper is not None
    # The stamps of what would come from the other device, without waiting for them.
    for block in range(1, 2 * PATIENCE):
        running.chain.take(0, upper._replace(t_ns=last.t_ns + 10**9 + block * 20_000_000))
    composed = running.until(lambda c: c.end is None)
    assert composed.why == 'fore: no estimate'
    assert composed.as_record() is None
    assert running.chain.missing['fore'] > 0
    running.heard('end effector: not composed: fore: no estimate')
    running.until(lambda c: c.t_ns > last.t_ns + 10**9)


def test_a_turned_joint_counts_from_the_next_time_on(
    running: Running, devices: list[ScriptedDevice], sample: Sample
) -> None:
    composed = running.until(lambda c: c.end is not None)
    assert composed.end is not None
    assert composed.end.rigid.position == pytest.approx([0.0, 0.0, 1.27])
    running.chain.set_angles({'shoulder': np.pi / 2, 'wrist': 1.0})
    assert running.chain.angles == (np.pi / 2, 0.0)
    running.send(devices, sample, 200)
    two = running.until(lambda c: c.end is not None and c.end.angles[0] > 0.0)
    assert two.end is not None
    assert two.end.rigid.position == pytest.approx([1.27, 0.0, 0.0], abs=1e-12)


def test_what_cannot_be_composed_ends_no_measurement(
    running: Running, devices: list[ScriptedDevice], sample: Sample, monkeypatch: pytest.MonkeyPatch
) -> None:
    running.until(lambda c: c.end is not None)

    def no_answer(*_: object) -> EndEffector:
        raise np.linalg.LinAlgError('SVD did not converge')

    with monkeypatch.context() as broken:
        broken.setattr(Chain, 'compose', no_answer)
        running.send(devices, sample, 200)
        composed = running.until(lambda c: c.end is None)
        assert composed.why == 'cannot be composed (SVD did not converge)'
        running.heard('end effector: not composed: cannot be composed (SVD did not converge)')
    running.send(devices, sample, 200)
    running.until(lambda c: c.end is not None and c.t_ns > composed.t_ns)
    assert running.chain.failed is None


def test_all_links_are_zeroed_and_recorded(
    running: Running, devices: list[ScriptedDevice], sample: Sample, tmp_path: Path
) -> None:
    running.until(lambda c: c.end is not None)
    assert all(change is not None for change in running.chain.zero())
    folders = [asked.result(WAIT_S) for asked in running.chain.record(True)]
    assert [folder.parent for folder in folders if folder is not None] == [
        tmp_path / 'recordings' / name for name in ('upper', 'fore')
    ]
    assert [asked.result(WAIT_S) for asked in running.chain.record(False)] == folders


def test_a_link_that_cannot_be_opened_ends_the_others(file: ChainFile, devices: list[ScriptedDevice]) -> None:
    devices[1].unplug()
    before = threading.active_count()
    with pytest.raises(DeviceError, match='port_1'):
        ChainSession(file, null_log)
    assert threading.active_count() <= before
