# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The cases of the blind suite as files, for any tool: ``python -m blind.given --out DIR``."""

import json
from pathlib import Path

import numpy as np
import yaml

from blind.campaign import options, over
from blind.cases import Case
from blind.run import observe, seal, selection
from psd_deflection.recordings.observation import Observation
from psd_deflection.records import CHANNELS
from psd_deflection.rig.config import load_rig

LOADS = ('load_fx', 'load_fy', 'load_tz')


def written(observed: Observation, stem: Path) -> None:
    """``stem.csv``: a row for each sample that is there; ``stem.yaml``: what of the rig is not as usual."""
    there = np.isfinite(observed.volts).all(axis=1)
    columns = [np.arange(len(observed.volts)) * observed.period, *observed.volts.T, *observed.loads.T]
    names = ['t', *CHANNELS, *LOADS]
    if observed.temperature is not None:
        columns, names = [*columns, observed.temperature], [*names, 'temperature']
    rows = np.column_stack(columns)[there]
    np.savetxt(stem.with_suffix('.csv'), rows, '%.10g', ',', header=','.join(names), comments='')
    usual = load_rig().values
    values = {name: value for name, value in observed.rig.values.items() if value != usual[name]}
    stem.with_suffix('.yaml').write_text(yaml.safe_dump({'/**': {'ros__parameters': values}}))


def given(job: tuple[Case, str, str]) -> str:
    """Return one case, from its sealed truth, into a folder of its own; its key."""
    case, sealed, folder = job
    out = Path(folder) / case.key
    out.mkdir(parents=True, exist_ok=True)
    names = []
    for i, observed in enumerate(observe(case, json.loads(Path(sealed).read_text())['truth']), start=1):
        names.append(f'recording_{i}')
        written(observed, out / names[-1])
    (out / 'case.json').write_text(json.dumps({'recordings': names, 'without': list(case.without)}, indent=1))
    return case.key


def main() -> None:
    parser = options(__doc__, jobs=1)
    chosen, args = selection(parser), parser.parse_args()
    folder, cases = Path(args.out), chosen(args)
    print(f'{len(cases)} cases; truths sealed: {seal(cases, folder, args.jobs)}')
    jobs = [(case, str(folder / 'sealed' / f'{case.key}.json'), str(folder / 'cases')) for case in cases]
    for _ in over(given, jobs, args.jobs, 'cases'):
        pass


if __name__ == '__main__':
    main()
