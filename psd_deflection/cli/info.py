"""Say what is in a recording: how long, how many samples, what is lost, which topics, whose rig.

The whole of it is read, so damage anywhere in it is found. Takes a bag folder, an .mcap or a .csv.

  psd-deflection info bags/clean
  psd-deflection info recordings/psd_20260101_120000 --json
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from msg_adapters import DEFLECTION, LOAD, SAMPLES
from psd_deflection.cli._progress import progress_of, told
from psd_deflection.cli._report import print_json, show
from psd_deflection.config import BY_NAME
from psd_deflection.recordings.readers import open_recording
from psd_deflection.recordings.recording import Recording

_EPOCH_FROM_NS = 10**18
"""September 2001; smaller times do not count from the epoch."""

_BREAK = 0.5
"""If time and sample numbers disagree by this share, the device was stopped or restarted between two blocks."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument('recording', metavar='REC', help='a bag folder, an .mcap or a .csv')
    parser.add_argument('--json', action='store_true', help='for programs: one JSON object')


def changed_parameters(parameters: Mapping[str, Any]) -> dict[str, Any]:
    """Parameters that differ from their defaults, and those that this version does not know."""
    return {k: v for k, v in parameters.items() if k not in BY_NAME or BY_NAME[k].default != v}


def lacks(recording: Recording, topics: Mapping[str, int]) -> list[str]:
    """Missing parts that some command needs, each with the fix."""
    found = []
    if not topics.get(SAMPLES):
        found.append(f'samples ({SAMPLES}): nothing can be computed from it')
    if not recording.parameters:
        found.append('parameters: the nominal rig is taken where --params-file gives no other')
    if recording.hello is None:
        found.append('what the device says of itself')
    if not topics.get(DEFLECTION):
        found.append(f'estimates ({DEFLECTION}): `psd-deflection replay` makes them')
    if not topics.get(LOAD):
        found.append(f'known loads ({LOAD}): `psd-deflection discover` needs them')
    return found


def summary(recording: Recording, quiet: bool = True) -> dict[str, Any]:
    """What ``info --json`` prints: times in s and ns, counts, metadata; reads the whole recording."""
    with told('counting messages', quiet=quiet):
        topics = recording.topics()
    blocks = samples = flagged = 0
    first = last = (0, 0)
    counted, lasted = 0, 0
    if topics.get(SAMPLES):
        expected_ns = 1e9 / recording.sample_rate_hz if recording.sample_rate_hz > 0.0 else 0.0
        for block in progress_of(recording.blocks(), topics[SAMPLES], quiet=quiet):
            begin, end = ((int(block.seq[i]), int(block.t_ns[i])) for i in (0, -1))
            if blocks == 0:
                first = last = begin
            # From the end of the block before, so that a pause of the device counts neither as samples nor as time.
            for n, dt in ((begin[0] - last[0], begin[1] - last[1]), (end[0] - begin[0], end[1] - begin[1])):
                if abs(dt - n * expected_ns) <= _BREAK * n * expected_ns:
                    counted, lasted = counted + n, lasted + dt
            last = end
            blocks += 1
            samples += len(block.seq)
            flagged += int((block.flags != 0).sum())
    path = recording.path
    files = [f for f in path.iterdir() if f.is_file()] if path.is_dir() else [path]
    return {
        'path': str(path),
        'bytes': sum(f.stat().st_size for f in files),
        'version': recording.version,
        'device_hello': recording.hello,
        'start_ns': first[1],
        'duration_s': (last[1] - first[1]) * 1e-9,
        'samples': samples,
        'lost': recording.lost(first[0], last[0], samples) if samples else 0,
        'restarts': len(recording.restarts),
        'flagged': flagged,
        'sample_rate_hz': counted * 1e9 / lasted if lasted else 0.0,
        'blocks': blocks,
        'block_size': recording.block_size,
        'topics': topics,
        'parameters': dict(recording.parameters),
        'changed_parameters': changed_parameters(recording.parameters),
        'changes': [{'t_ns': c.t_ns, 'block': c.block, 'values': dict(c.values)} for c in recording.changes],
        'lacks': lacks(recording, topics),
        'complete': recording.complete,
        'warnings': list(recording.warnings),
    }


def run(args: argparse.Namespace) -> int:
    """Print the summary."""
    found = summary(open_recording(Path(args.recording)), quiet=args.json)
    if args.json:
        print_json(found, indent=2)
        return 0
    show(*_lines(found))
    return 0


def _lines(found: Mapping[str, Any]) -> list[str]:
    def row(name: str, text: str) -> str:
        return f'  {name:<12} {text}'

    out = [f'{found["path"]}: {found["bytes"] / 1e6:.2f} MB']
    out.append(row('state', 'complete' if found['complete'] else 'INCOMPLETE, see below'))
    if found['version']:
        out.append(row('recorded by', f'psd_deflection {found["version"]}'))
    if found['device_hello'] is not None:
        hello = {k: ' '.join(map(str, v)) if isinstance(v, list) else v for k, v in found['device_hello'].items()}
        out.append(row('device', ', '.join(f'{k} {v}' for k, v in hello.items())))
    start, samples, lost = found['start_ns'], found['samples'], found['lost']
    share = 100.0 * lost / (samples + lost) if samples else 0.0
    if not samples:
        out.append(row('samples', 'none'))
    else:
        if start >= _EPOCH_FROM_NS:
            when = datetime.fromtimestamp(start // 1_000_000_000, UTC).strftime('%Y-%m-%d %H:%M:%S')
            out.append(row('start', f'{when}.{start % 1_000_000_000:09d} UTC'))
        else:
            out.append(row('start', f'{start * 1e-9:.9f} s'))
        out.append(row('duration', f'{found["duration_s"]:.3f} s'))
        out.append(row('samples', f'{samples} present, {lost} lost ({share:.3g} %), {found["flagged"]} flagged'))
        if found['restarts']:
            out.append(row('restarts', f'{found["restarts"]} of the device'))
        out.append(row('rate', f'{found["sample_rate_hz"]:.6g} samples/s'))
        out.append(row('blocks', f'{found["blocks"]} of up to {found["block_size"]} samples'))
    out += [row('lacks' if i == 0 else '', text) for i, text in enumerate(found['lacks'])]
    out.append('  topics')
    width = max((len(t) for t in found['topics']), default=0)
    out += [f'    {topic:<{width}}  {count}' for topic, count in sorted(found['topics'].items())]
    if found['parameters'] and not found['changed_parameters']:
        out.append('  all parameters at their defaults')
    elif found['parameters']:
        out.append('  parameters that are not at their defaults')
        out += [f'    {k} = {v}' for k, v in sorted(found['changed_parameters'].items())]
    out += [
        f'  from block {c["block"]} on: ' + ', '.join(f'{k} = {v}' for k, v in c['values'].items())
        for c in found['changes']
    ]
    out += [f'  warning: {w}' for w in found['warnings']]
    return out
