# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A new message costs a record, a file of msg_adapters, a line in its ``__init__`` and whoever makes the record.

The package is copied, the two are added to the copy, and a program of its own records with it.
"""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

ROOT = Path(__file__).resolve().parents[2]
ADAPTER = '''
"""test_msgs/Humidity: percent."""

from collections.abc import Mapping
from typing import Any, NamedTuple

from msg_adapters.header import Fields, header, stamp_ns
from msg_adapters.message_type import MessageType

MESSAGE = MessageType(
    'test_msgs/msg/Humidity',
    'RIHS01_0',
    'std_msgs/Header header\\nfloat64 percent\\ntest_msgs/Sensor[] sensors\\n',
    {'test_msgs/Sensor': 'string name\\nuint16 number\\n'},
)


class Humidity(NamedTuple):
    t_ns: int
    percent: float


def from_humidity(h: Humidity) -> Fields:
    sensors = [{'name': name, 'number': i} for i, name in enumerate(('base', 'tip'))]
    return {'header': header(h.t_ns, 'link_base'), 'percent': h.percent, 'sensors': sensors}


def to_humidity(fields: Mapping[str, Any]) -> Humidity:
    return Humidity(stamp_ns(fields), fields['percent'])
'''
PRODUCER = """
import sys
from msg_adapters import INPUTS, TOPIC_TYPES, from_fields, humidity
from psd_deflection.cli.main import main
from psd_deflection.recordings import cdr
from psd_deflection.recordings.write.bag_writer import BagWriter
from psd_deflection.recordings.read.readers import open_recording

assert humidity.__file__.startswith(sys.argv[2]), humidity.__file__
with BagWriter(sys.argv[1], rig_values={}) as bag:
    for i in range(3):
        bag.put(humidity.Humidity(1_000_000_000 + i, 40.5 + i))
assert TOPIC_TYPES['/environment/humidity'] == 'test_msgs/msg/Humidity'
assert '/environment/humidity' in INPUTS
read = [from_fields(m.channel.topic, cdr.decode(m.channel.type, m.cdr)) for m in open_recording(sys.argv[1]).messages()]
assert read == [humidity.Humidity(1_000_000_000 + i, 40.5 + i) for i in range(3)], read
sys.exit(main(['info', sys.argv[1], '--json']))
"""


def test_a_made_up_message_is_recorded_read_and_listed(tmp_path: Path) -> None:
    package = tmp_path / 'msg_adapters'
    shutil.copytree(ROOT / 'msg_adapters', package, ignore=shutil.ignore_patterns('__pycache__'))
    (package / 'humidity.py').write_text(ADAPTER)
    front = (package / '__init__.py').read_text()
    adapter = 'humidity.MESSAGE, humidity.Humidity, humidity.from_humidity, humidity.to_humidity'
    line = f"    Topic('/environment/humidity', 'humidity of the air, %', {adapter}, BEST_EFFORT),"
    for place, added in (('from msg_adapters import (', '    humidity,'), ('TOPICS = (', line)):
        assert front.count(place + '\n') == 1
        front = front.replace(place + '\n', f'{place}\n{added}\n')
    (package / '__init__.py').write_text(front)
    folder = tmp_path / 'run'
    done = subprocess.run(
        [sys.executable, '-c', PRODUCER, str(folder), str(tmp_path)],
        env={**os.environ, 'PYTHONPATH': f'{tmp_path}{os.pathsep}{ROOT}'},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)['topics'] == {'/environment/humidity': 3}
    store = get_typestore(Stores.EMPTY)
    with Reader(folder) as reader:
        (connection,) = reader.connections
        store.register(get_types_from_msg(connection.msgdef.data, connection.msgtype))
        messages = [store.deserialize_cdr(raw, connection.msgtype) for _, _, raw in reader.messages()]
    assert [m.percent for m in messages] == [40.5, 41.5, 42.5]
    assert [[(s.name, s.number) for s in m.sensors] for m in messages] == [[('base', 0), ('tip', 1)]] * 3
