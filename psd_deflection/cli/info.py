"""Say what is in a recording: how long, how many samples, what is lost, which topics, whose rig.

The whole of it is read, so damage anywhere in it is found. Takes a bag folder, an .mcap or a .csv.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from msg_adapters import SAMPLES
from psd_deflection.io.recording import Recording
from psd_deflection.io.recordings import open_recording
from psd_deflection.parameters import BY_NAME

_EPOCH_FROM_NS = 10**18
"""September 2001; smaller times count from a zero of their own."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument('recording', metavar='REC', help='a bag folder, an .mcap or a .csv')
    parser.add_argument('--json', action='store_true', help='for programs: one JSON object')


def changed_parameters(parameters: Mapping[str, Any]) -> dict[str, Any]:
    """Those that are not at their default, and those that this version does not know."""
    return {k: v for k, v in parameters.items() if k not in BY_NAME or BY_NAME[k].default != v}


def survey(recording: Recording) -> dict[str, Any]:
    """What ``info --json`` prints: times in s and ns, counts, metadata; reads the whole recording."""
    topics = recording.topics()
    blocks = samples = flagged = 0
    first = last = (0, 0)
    if topics.get(SAMPLES):
        for block in recording.blocks():
            if blocks == 0:
                first = (int(block.seq[0]), int(block.t_ns[0]))
            last = (int(block.seq[-1]), int(block.t_ns[-1]))
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
        'lost': last[0] - first[0] + 1 - samples if samples else 0,
        'flagged': flagged,
        'sample_rate_hz': recording.sample_rate_hz if samples > 1 else 0.0,
        'blocks': blocks,
        'block_size': recording.block_size,
        'topics': topics,
        'parameters': dict(recording.parameters),
        'changed_parameters': changed_parameters(recording.parameters),
        'changes': [{'t_ns': c.t_ns, 'block': c.block, 'values': dict(c.values)} for c in recording.changes],
        'complete': recording.complete,
        'warnings': list(recording.warnings),
    }


def run(args: argparse.Namespace) -> int:
    """Print the survey."""
    found = survey(open_recording(Path(args.recording)))
    if args.json:
        print(json.dumps(found, indent=2))
        return 0
    for line in _lines(found):
        print(line)
    return 0


def _lines(found: Mapping[str, Any]) -> list[str]:
    def row(name: str, text: str) -> str:
        return f'  {name:<12} {text}'

    out = [f'{found["path"]}: {found["bytes"] / 1e6:.2f} MB']
    out.append(row('state', 'complete' if found['complete'] else 'INCOMPLETE, see below'))
    if found['version']:
        out.append(row('recorded by', f'psd_deflection {found["version"]}'))
    if found['device_hello'] is not None:
        out.append(row('device', ', '.join(f'{k} {v}' for k, v in found['device_hello'].items())))
    start = found['start_ns']
    if start >= _EPOCH_FROM_NS:
        when = datetime.fromtimestamp(start // 1_000_000_000, UTC).strftime('%Y-%m-%d %H:%M:%S')
        out.append(row('start', f'{when}.{start % 1_000_000_000:09d} UTC'))
    else:
        out.append(row('start', f'{start * 1e-9:.9f} s'))
    out.append(row('duration', f'{found["duration_s"]:.3f} s'))
    samples, lost = found['samples'], found['lost']
    share = 100.0 * lost / (samples + lost) if samples else 0.0
    out.append(row('samples', f'{samples} present, {lost} lost ({share:.3g} %), {found["flagged"]} flagged'))
    out.append(row('rate', f'{found["sample_rate_hz"]:.6g} samples/s'))
    out.append(row('blocks', f'{found["blocks"]} of up to {found["block_size"]} samples'))
    out.append('  topics')
    width = max((len(t) for t in found['topics']), default=0)
    out += [f'    {topic:<{width}}  {count}' for topic, count in sorted(found['topics'].items())]
    if not found['parameters']:
        out.append('  no parameters in it')
    elif not found['changed_parameters']:
        out.append('  all parameters at their defaults')
    else:
        out.append('  parameters that are not at their defaults')
        out += [f'    {k} = {v}' for k, v in sorted(found['changed_parameters'].items())]
    out += [
        f'  from block {c["block"]} on: ' + ', '.join(f'{k} = {v}' for k, v in c['values'].items())
        for c in found['changes']
    ]
    out += [f'  warning: {w}' for w in found['warnings']]
    return out
