"""A message joins by the four files that docs/extending.md names, tried on copies; rosbags reads what is recorded."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

ROOT = Path(__file__).parents[2]
TYPE = 'sensor_msgs/msg/FluidPressure'

RECORD = '''

class PressureReading(NamedTuple):
    """Air pressure, Pa."""

    t_ns: int
    pascal: float
'''

ADAPTER = '''"""sensor_msgs/FluidPressure: pascal."""

from msg_adapters.header import header, stamp_ns
from msg_adapters.message_type import MessageType
from psd_deflection.records import PressureReading

MESSAGE = MessageType(
    'sensor_msgs/msg/FluidPressure',
    '{type_hash}',
    'std_msgs/Header header\\nfloat64 fluid_pressure\\nfloat64 variance\\n',
)


def from_reading(reading):
    return {{'header': header(reading.t_ns, 'link_base'), 'fluid_pressure': reading.pascal, 'variance': 0.0}}


def to_reading(fields):
    return PressureReading(stamp_ns(fields), float(fields['fluid_pressure']))
'''

TOPIC = """    Topic(
        '/environment/pressure',
        fluid_pressure.MESSAGE,
        PressureReading,
        fluid_pressure.from_reading,
        fluid_pressure.to_reading,
    ),
"""

PRODUCER = """
import sys
from pathlib import Path

from msg_adapters import INPUTS, from_fields, to_messages
from psd_deflection.config import load_rig
from psd_deflection.recordings.bag_writer import BagWriter
from psd_deflection.records import PressureReading

reading = PressureReading(1_700_000_000_123_456_789, 101_325.5)
(message,) = to_messages(reading)
assert message.topic in INPUTS
assert from_fields(message.topic, message.fields) == reading
with BagWriter(Path(sys.argv[1]), rig_values=load_rig().values) as bag:
    bag.write(reading)
"""


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    for package in ('psd_deflection', 'msg_adapters'):
        shutil.copytree(ROOT / package, tmp_path / package, ignore=shutil.ignore_patterns('__pycache__'))
    return tmp_path


def replace_once(path: Path, before: str, after: str) -> None:
    text = path.read_text()
    assert text.count(before) == 1, f'{path.name}: {before!r}'
    path.write_text(text.replace(before, after))


def test_a_message_joins_and_is_recorded(copy: Path) -> None:
    store = get_typestore(Stores.ROS2_JAZZY)
    replace_once(
        copy / 'psd_deflection' / 'records.py', '\nRecord = (\n', f'{RECORD}\n\nRecord = (\n    PressureReading |\n'
    )
    (copy / 'msg_adapters' / 'fluid_pressure.py').write_text(ADAPTER.format(type_hash=store.hash_rihs01(TYPE)))
    joined = copy / 'msg_adapters' / '__init__.py'
    replace_once(joined, '\nTOPICS = (\n', f'\nTOPICS = (\n{TOPIC}')
    replace_once(joined, '    diagnostic_array,\n', '    diagnostic_array,\n    fluid_pressure,\n')
    replace_once(joined, '    ParameterChange,\n', '    ParameterChange,\n    PressureReading,\n')
    bag = copy / 'bag'
    environment = {**os.environ, 'PYTHONPATH': str(copy)}
    done = subprocess.run(
        [sys.executable, '-c', PRODUCER, str(bag)],
        cwd=copy,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    with Reader(bag) as reader:
        (found,) = reader.messages()
    connection, t_ns, cdr = found
    assert (connection.topic, connection.msgtype, t_ns) == ('/environment/pressure', TYPE, 1_700_000_000_123_456_789)
    message = store.deserialize_cdr(cdr, TYPE)
    assert (message.fluid_pressure, message.header.frame_id) == (101_325.5, 'link_base')
