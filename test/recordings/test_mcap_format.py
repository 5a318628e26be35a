# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""MCAP files, written and read: the package ``mcap`` is the judge."""

import io
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.data_stream import RecordBuilder
from mcap.records import Channel as OracleChannel
from mcap.records import Metadata as OracleMetadata
from mcap.records import Schema as OracleSchema
from mcap.writer import CompressionType, Writer

from psd_deflection.recordings.mcap_format import RECORD_HEAD, Channel, DamagedError, Metadata, Opcode, Schema, parsed
from psd_deflection.recordings.write.mcap_writer import McapWriter

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


def by_oracle(record: Schema | Channel | Metadata) -> bytes:
    """The judge's bytes of a record."""
    builder = RecordBuilder()
    if isinstance(record, Schema):
        OracleSchema(**record._asdict()).write(builder)
    elif isinstance(record, Metadata):
        OracleMetadata(**record._asdict()).write(builder)
    else:
        OracleChannel(
            id=record.id,
            topic=record.topic,
            message_encoding=record.encoding,
            metadata=dict(record.metadata),
            schema_id=record.schema_id,
        ).write(builder)
    return bytes(builder.end())


@given(SCHEMAS | CHANNELS | METADATA)
def test_a_record_has_the_bytes_of_the_judge_and_comes_back(record: Schema | Channel | Metadata) -> None:
    written = by_oracle(record)
    assert (record.content(), parsed(written[0], record.content())) == (written[RECORD_HEAD.size :], record)


@given(SCHEMAS | CHANNELS | METADATA, st.data())
def test_a_record_that_ends_too_early_is_damaged(record: Schema | Channel | Metadata, data: st.DataObject) -> None:
    content = record.content()
    cut = content[: data.draw(st.integers(0, len(content) - 1))]
    with pytest.raises(DamagedError):
        parsed(by_oracle(record)[0], cut)


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
    oracle = Writer(theirs, compression=CompressionType.ZSTD, enable_crcs=True)
    oracle.start(profile='ros2', library='us')
    wrote(oracle, calls)
    assert ours.getvalue() == theirs.getvalue()
