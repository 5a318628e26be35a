# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Rows of many recordings as one Parquet file."""

from __future__ import annotations

import importlib
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from psd_deflection.base.errors import ConfigError, RecordingError
from psd_deflection.base.files import creating

ENDING = '.parquet'
RECORDING = 'recording'
"""Name of the first column."""
FAILED = 'psd_deflection.failed'
"""Key of the file's metadata: the recordings without rows, with their errors, as JSON."""


class Field(NamedTuple):
    """A column: ``kind`` is str, int, float or bool; ``unit`` is '' if it has none."""

    name: str
    kind: type
    unit: str = ''


ERROR = Field('error', str)
"""Column of a table with one row a recording: why it failed, else empty."""


def is_parquet(path: str | None) -> bool:
    """Whether ``path`` has the ending of such a file."""
    return path is not None and Path(path).suffix.lower() == ENDING


class ParquetFile:
    """A new file of ``fields`` behind the name of the recording; the unit is in each column's metadata.

    The same rows make the same bytes. Raises RecordingError if ``path`` exists or the disk rejects, ConfigError if
    pyarrow is not installed.
    """

    def __init__(self, path: str | Path, fields: Sequence[Field]) -> None:
        try:
            self._arrow = importlib.import_module('pyarrow')
            parquet = importlib.import_module('pyarrow.parquet')
        except ImportError as error:
            raise ConfigError(
                f"--out {path} needs pyarrow ({error}): `pip install 'psd_deflection[parquet]'`"
            ) from None
        self.path = Path(path)
        self.fields = tuple(fields)
        with creating(self.path):
            self._stream = self.path.open('xb')
        self._writer = parquet.ParquetWriter(self._stream, self._schema(), compression='zstd')

    def _schema(self) -> Any:
        pa = self._arrow
        kinds = {str: pa.string(), int: pa.int64(), float: pa.float64(), bool: pa.bool_()}
        return pa.schema(
            [
                pa.field(RECORDING, pa.dictionary(pa.int32(), pa.string())),
                *(pa.field(f.name, kinds[f.kind], metadata={'unit': f.unit} if f.unit else None) for f in self.fields),
            ]
        )

    def put(self, recordings: Sequence[str], columns: Mapping[str, Any]) -> None:
        """Append rows: the recording of each (n,), and a column (n,) for each of the fields."""
        pa, schema = self._arrow, self._schema()
        cells = [pa.array(columns[f.name], type=schema.field(f.name).type) for f in self.fields]
        names = pa.array(recordings, pa.string()).dictionary_encode()
        self._do(lambda: self._writer.write_table(pa.Table.from_arrays([names, *cells], schema=schema)))

    def close(self, failed: Mapping[str, str]) -> None:
        """End the file; ``failed``: the error of each recording without rows, kept in its metadata as JSON."""

        def end() -> None:
            self._writer.add_key_value_metadata({FAILED: json.dumps(dict(failed))})
            self._writer.close()
            self._stream.close()

        self._do(end)

    def __enter__(self) -> ParquetFile:
        return self

    def __exit__(self, *_: object) -> None:
        """Let go of the file; without :meth:`close` it has no end and cannot be read."""
        self._stream.close()

    def _do(self, action: Callable[[], None]) -> None:
        try:
            action()
        except OSError as error:
            raise RecordingError(f'{self.path}: cannot be written ({error.strerror or error})') from None
