"""MCAP files and messages, written and read: the packages ``mcap`` and ``mcap-ros2-support`` are the judges."""

from __future__ import annotations

import contextlib
import io
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.data_stream import RecordBuilder
from mcap.reader import make_reader
from mcap.records import Channel as JudgesChannel
from mcap.records import Metadata as JudgesMetadata
from mcap.records import Schema as JudgesSchema
from mcap.writer import CompressionType, Writer
from mcap_ros2.decoder import DecoderFactory

from msg_adapters import MESSAGE_TYPES
from msg_adapters.message_type import MessageType
from psd_deflection.recordings import cdr
from psd_deflection.recordings.mcap_format import RECORD_HEAD, Channel, Metadata, Opcode, Schema, parsed
from psd_deflection.recordings.read.allowance import DamagedError
from psd_deflection.recordings.write.mcap_writer import McapWriter

BAGS = sorted((Path(__file__).parent.parent.parent / 'bags').glob('*/*.mcap'))
TEXTS = st.text(max_size=8)
U16, U32, U64 = (st.integers(0, 2**bits - 1) for bits in (16, 32, 64))
SCHEMAS = st.builds(Schema, id=U16, name=TEXTS, encoding=TEXTS, data=st.binary(max_size=9))
CHANNELS = st.builds(
    Channel, id=U16, schema_id=U16, topic=TEXTS, encoding=TEXTS, metadata=st.dictionaries(TEXTS, TEXTS, max_size=3)
)
METADATA = st.builds(Metadata, name=TEXTS, metadata=st.dictionaries(TEXTS, TEXTS, max_size=3))

Call = tuple[str, tuple[Any, ...]]
CALLS = st.lists(
    st.tuples(st.just('message'), st.tuples(st.integers(1, 3), U64, st.binary(max_size=50), U64, U32))
    | st.tuples(st.just('long message'), st.tuples(st.integers(1, 3), U64, st.integers(1, 3), U64, U32))
    | st.tuples(st.just('metadata'), st.tuples(TEXTS, st.dictionaries(TEXTS, TEXTS, max_size=3)))
    | st.tuples(st.just('flush'), st.just(())),
    max_size=30,
)


def judged(record: Schema | Channel | Metadata) -> bytes:
    """The judge's bytes of a record."""
    builder = RecordBuilder()
    if isinstance(record, Schema):
        JudgesSchema(**record._asdict()).write(builder)
    elif isinstance(record, Metadata):
        JudgesMetadata(**record._asdict()).write(builder)
    else:
        JudgesChannel(
            id=record.id,
            topic=record.topic,
            message_encoding=record.encoding,
            metadata=dict(record.metadata),
            schema_id=record.schema_id,
        ).write(builder)
    return bytes(builder.end())


@given(SCHEMAS | CHANNELS | METADATA)
def test_a_record_has_the_bytes_of_the_judge_and_comes_back(record: Schema | Channel | Metadata) -> None:
    written = judged(record)
    assert record.content() == written[RECORD_HEAD.size :]
    assert parsed(written[0], record.content()) == record


@given(SCHEMAS | CHANNELS | METADATA, st.data())
def test_a_record_that_ends_too_early_is_damaged(record: Schema | Channel | Metadata, data: st.DataObject) -> None:
    content = record.content()
    cut = content[: data.draw(st.integers(0, len(content) - 1))]
    with pytest.raises(DamagedError):
        parsed(judged(record)[0], cut)


@pytest.mark.parametrize('opcode', [Opcode.SCHEMA, Opcode.METADATA])
def test_a_text_that_is_not_utf_8_is_damage(opcode: Opcode) -> None:
    with pytest.raises(DamagedError, match='not UTF-8'):
        parsed(opcode, b'\1\0\0\0\xff' * 9 if opcode is Opcode.METADATA else b'\1\0' + b'\1\0\0\0\xff' * 9)


def wrote(writer: Any, calls: list[Call]) -> None:
    schema = writer.register_schema('pkg/msg/Name', 'ros2msg', b'uint8 x')
    for topic in ('/a', '/b', '/c'):
        writer.register_channel(topic, 'cdr', schema, {'qos': topic})
    for what, words in calls:
        if what == 'metadata':
            writer.add_metadata(*words)
        elif what == 'flush':
            writer.flush()
        else:
            channel, log_time, data, publish_time, sequence = words
            # Some are so long that a chunk ends by its size.
            content = data if what == 'message' else bytes(data * 300_000)
            writer.add_message(channel, log_time, content, publish_time, sequence)
    writer.finish()


@given(CALLS)
def test_a_file_has_the_bytes_of_the_judge(calls: list[Call]) -> None:
    ours, theirs = io.BytesIO(), io.BytesIO()
    wrote(McapWriter(ours, io.BytesIO(), library='us'), calls)
    judge = Writer(theirs, compression=CompressionType.ZSTD, enable_crcs=True)
    judge.start(profile='ros2', library='us')
    wrote(judge, calls)
    assert ours.getvalue() == theirs.getvalue()


VALUES: Mapping[str, st.SearchStrategy[Any]] = {
    'bool': st.booleans(),
    'float32': st.floats(width=32, allow_nan=False),
    'float64': st.floats(allow_nan=False),
    'string': st.text(st.characters(codec='utf-8', exclude_characters='\0'), max_size=5),
    **{f'int{n}': st.integers(-(2 ** (n - 1)), 2 ** (n - 1) - 1) for n in (8, 16, 32, 64)},
    **{f'uint{n}': st.integers(0, 2**n - 1) for n in (8, 16, 32, 64)},
    'byte': st.integers(0, 255),
    'char': st.integers(0, 255),
}


def values_of(message: MessageType, kind: str = '') -> st.SearchStrategy[Any]:
    """Any value of a type, an array of one, or a message."""
    if kind.endswith(']'):
        inner, _, length = kind[:-1].partition('[')
        size = int(length) if length else None
        if inner in ('uint8', 'byte'):
            return st.binary(min_size=size or 0, max_size=size or 6)
        return st.lists(values_of(message, inner), min_size=size or 0, max_size=size or 3)
    if kind in VALUES:
        return VALUES[kind]
    return st.fixed_dictionaries({name: values_of(message, inner) for inner, name in message.members(kind)})


def plain(value: Any) -> Any:
    """The judge's objects as dicts and lists."""
    if isinstance(value, list):
        return [plain(v) for v in value]
    names = getattr(value, '__slots__', None)
    return value if names is None else {name: plain(getattr(value, name)) for name in names}


@pytest.mark.parametrize('name', sorted(MESSAGE_TYPES))
@given(data=st.data())
def test_a_message_is_read_as_the_judge_reads_it(name: str, data: st.DataObject) -> None:
    message = MESSAGE_TYPES[name]
    fields = data.draw(values_of(message))
    encoded = cdr.encode(name, fields)
    judge = DecoderFactory().decoder_for(
        'cdr', JudgesSchema(id=1, name=name, encoding='ros2msg', data=message.definition.encode())
    )
    assert judge is not None
    assert cdr.decode(name, encoded) == plain(judge(encoded)) == fields


@pytest.mark.parametrize('name', sorted(MESSAGE_TYPES))
@given(junk=st.binary(max_size=300), data=st.data())
def test_bytes_that_are_no_message_are_refused_or_a_message(name: str, junk: bytes, data: st.DataObject) -> None:
    encoded = cdr.encode(name, data.draw(values_of(MESSAGE_TYPES[name])))
    cut = encoded[: data.draw(st.integers(0, len(encoded) - 1))]
    for wrong in (junk, cut, b'\0\1\0\0' + junk, b'\0\0\0\0' + junk):
        with contextlib.suppress(ValueError):
            cdr.decode(name, wrong)


def test_an_array_that_declares_more_than_there_is_costs_nothing() -> None:
    four_thousand_million = b'\0\1\0\0' + struct.pack('<iII', 0, 0, 1) + b'\0\0\0\0' + b'\xff' * 4
    with pytest.raises(ValueError, match='not a diagnostic_msgs/msg/DiagnosticArray'):
        cdr.decode('diagnostic_msgs/msg/DiagnosticArray', four_thousand_million)


def test_big_endian_numbers_are_read() -> None:
    encoded = (
        b'\0\0\0\0' + struct.pack('>iI', 3, 4) + struct.pack('>I', 2) + b'a\0' + b'\0\0' + struct.pack('>7d', *range(7))
    )
    fields = cdr.decode('geometry_msgs/msg/PoseStamped', encoded)
    assert fields['header'] == {'stamp': {'sec': 3, 'nanosec': 4}, 'frame_id': 'a'}
    assert [*fields['pose']['position'].values(), *fields['pose']['orientation'].values()] == list(range(7))


@pytest.mark.parametrize('bag', BAGS, ids=lambda p: p.stem)
def test_a_recording_is_written_again_with_the_bytes_of_the_judge(bag: Path) -> None:
    """Every message of the golden recordings, in chunks of some hundred."""
    ours, theirs = io.BytesIO(), io.BytesIO()
    writer = McapWriter(ours, io.BytesIO(), library='us')
    judge = Writer(theirs, compression=CompressionType.ZSTD, enable_crcs=True)
    judge.start(profile='ros2', library='us')
    numbers: dict[int, int] = {}
    with bag.open('rb') as stream:
        for n, (schema, channel, message) in enumerate(make_reader(stream).iter_messages()):
            assert schema is not None
            if channel.id not in numbers:
                for target in (writer, judge):
                    known = target.register_schema(schema.name, schema.encoding, schema.data)
                    numbers[channel.id] = target.register_channel(
                        channel.topic, channel.message_encoding, known, channel.metadata
                    )
            for target in (writer, judge):
                target.add_message(
                    numbers[channel.id], message.log_time, message.data, message.publish_time, message.sequence
                )
                if n % 300 == 0:
                    target.flush()
    for target in (writer, judge):
        target.finish()
    assert ours.getvalue() == theirs.getvalue()
