"""Opens a recording of any kind: every command that reads one takes a bag folder, ``.mcap`` or ``.csv``."""

from __future__ import annotations

import itertools
from pathlib import Path

from psd_deflection.base.errors import RecordingError
from psd_deflection.base.spelling import did_you_mean
from psd_deflection.recordings.mcap_format import MAGIC
from psd_deflection.recordings.read.bag_reader import BagRecording
from psd_deflection.recordings.read.csv_reader import CsvRecording
from psd_deflection.recordings.recording import WHOLE, Recording, Span

MOST_NAMES = 1000
"""Names of a folder that are looked at for one that was meant."""


def open_recording(
    path: str | Path,
    *,
    block_size: int | None = None,
    sample_rate_hz: float | None = None,
    namespace: str | None = None,
    span: Span = WHOLE,
) -> Recording:
    """Open ``path``: a bag folder, a lone ``.mcap`` or a ``.csv``.

    ``block_size``: samples per block; by default from the recording's own parameters (20 if it has
    none). ``sample_rate_hz``: for a CSV whose times do not determine it.
    ``namespace``: of the recorded node, for a bag of several rigs. ``span``: the part that is meant.
    Raises RecordingError if it is none of the three, or cannot be read, and as :meth:`Recording.crop` does.
    """
    whole = _open(Path(path), block_size, sample_rate_hz, namespace)
    return whole if span == WHOLE else whole.crop(*span)


def _open(path: Path, block_size: int | None, sample_rate_hz: float | None, namespace: str | None) -> Recording:
    suffix = path.suffix.lower()
    try:
        if path.is_dir():
            return BagRecording(path, block_size, namespace)
        if not path.exists():
            raise RecordingError(f'{path}: no such recording{_meant(path)}')
        if not path.is_file():
            # A pipe would wait for its writer, and it cannot be read twice.
            raise RecordingError(f'{path}: is no file; write it to one first')
        if suffix == '.csv':
            return CsvRecording(path, block_size, sample_rate_hz)
        with path.open('rb') as stream:
            is_mcap = stream.read(len(MAGIC)) == MAGIC
    except OSError as error:
        raise RecordingError(f'{path}: cannot be read ({error.strerror or error})') from None
    if is_mcap or suffix == '.mcap':
        return BagRecording(path, block_size, namespace)
    if path.name == 'metadata.yaml':
        return BagRecording(path.parent, block_size, namespace)
    raise RecordingError(f'{path}: is no recording: a bag folder, an .mcap or a .csv is read')


def _meant(path: Path) -> str:
    """``; did you mean X?`` if the folder of ``path`` holds something of a similar name."""
    try:
        return did_you_mean(path.name, sorted(p.name for p in itertools.islice(path.parent.iterdir(), MOST_NAMES)))
    except OSError:
        return ''
