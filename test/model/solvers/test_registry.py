# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A method joins by its module and one line of the registry; what is for comparison only does not run live."""

import json
from pathlib import Path
from types import MappingProxyType

import pytest

from psd_deflection.base.errors import ConfigError
from psd_deflection.base.log import texts
from psd_deflection.cli.main import main
from psd_deflection.model.solvers import SOLVERS, registry
from psd_deflection.model.solvers.registry import Entry, check_live, solver_class
from psd_deflection.rig.config import rig_from_values
from psd_deflection.run.session import Session
from psd_deflection.studies.budget.chain import METHODS

BAG = Path(__file__).parents[3] / 'bags' / 'clean'
MADE_UP = """
from psd_deflection.base.errors import SolverError
from psd_deflection.model.solvers.exact import ExactSolver


class MadeUp(ExactSolver):
    name = 'made_up'
    budgeted_as = 'wls'

    def __init__(self, geometry, shift=0.0):
        super().__init__(geometry)
        self._shift = shift

    @classmethod
    def options_from_rig(cls, rig):
        return {'shift': rig.estimator.twist_hold}

    def solve(self, dots, variances):
        found = super().solve(dots, variances)
        return found._replace(dx=found.dx + self._shift)


class Particular(ExactSolver):
    name = 'particular'
    budgeted_as = ''

    def __init__(self, geometry):
        if geometry.link_length == 0.585:
            raise SolverError('not with a link of 0.585 m')
        super().__init__(geometry)
"""


@pytest.fixture
def joined(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """``made_up`` and ``particular`` in the registry."""
    (tmp_path / 'made_up_methods.py').write_text(MADE_UP)
    monkeypatch.syspath_prepend(tmp_path)
    more = {
        name: Entry(f'made_up_methods:{cls}') for name, cls in (('made_up', 'MadeUp'), ('particular', 'Particular'))
    }
    monkeypatch.setattr(registry, 'SOLVERS', MappingProxyType({**SOLVERS, **more}))


def rig_file(folder: Path, text: str) -> str:
    path = folder / 'rig.yaml'
    path.write_text('/**:\n  ros__parameters:\n' + ''.join(f'    {line}\n' for line in text.split('; ')))
    return str(path)


@pytest.mark.parametrize('name', SOLVERS)
def test_the_registry_and_the_classes_agree(name: str) -> None:
    cls = solver_class(name)
    assert cls.name == name
    assert cls.budgeted_as in (*METHODS, '')
    assert SOLVERS[name].instead == '' or not SOLVERS[SOLVERS[name].instead].instead


@pytest.mark.usefixtures('joined')
def test_a_new_method_replays_with_its_options(tmp_path: Path) -> None:
    out = tmp_path / 'out.csv'
    file = rig_file(tmp_path, 'solver: made_up; solvers: [made_up, exact]; twist_hold: 0.25')
    assert main(['replay', str(BAG), '--params-file', file, '--out', str(out)]) == 0
    head, row = (line.split(',') for line in out.read_text().splitlines()[:2])
    cells = dict(zip(head, map(float, row), strict=True))
    assert cells['dx'] == cells['made_up_dx'] == cells['exact_dx'] + 0.25
    assert cells['made_up_theta'] == cells['exact_theta']


@pytest.mark.usefixtures('joined')
def test_a_new_method_is_budgeted_as_it_declares(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['budget', '--json', '--params-file', rig_file(tmp_path, 'solver: made_up')]) == 0
    assert json.loads(capsys.readouterr().out)['method'] == 'wls'
    assert main(['budget', '--json', '--params-file', rig_file(tmp_path, 'solver: particular')]) == 3
    assert "solver = 'particular': the budget has no model of its errors" in capsys.readouterr().err


@pytest.mark.usefixtures('joined')
def test_a_new_method_is_compared_or_rejected_by_name(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['thesis', 'compare-methods']) == 0
    lines = capsys.readouterr().out.splitlines()
    rows = [[line[30:] for line in lines if line.startswith(name + '  ')] for name in ('made_up', 'exact (default)')]
    assert len(rows[0]) == 2
    assert rows[0] == rows[1]
    assert 'particular is not in the table: not with a link of 0.585 m' in lines


COMPARISON_ONLY = [name for name, entry in SOLVERS.items() if entry.instead]


@pytest.mark.parametrize('name', COMPARISON_ONLY)
def test_a_printed_method_is_no_live_runs_answer(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    message = (
        f"solver = '{name}': a method as printed, for comparison only: for a live run take '{SOLVERS[name].instead}'"
    )
    with pytest.raises(ConfigError, match=message):
        Session(rig_from_values({'solver': name, 'port': '/dev/nothing_here'}), texts(print))
    file = rig_file(tmp_path, f'solver: {name}; port: /dev/nothing_here')
    for command in (['estimator', '--no-ros'], ['monitor', '--http-port', '0']):
        assert main([*command, '--params-file', file]) == 3
        assert message in capsys.readouterr().err
    assert main(['estimator', '--no-ros', '--solver', name, '--port', '/dev/nothing_here']) == 2
    assert '--' + message in capsys.readouterr().err


def test_a_printed_method_may_be_listed_live_and_may_replay(tmp_path: Path) -> None:
    check_live(rig_from_values({'solvers': ['exact', *COMPARISON_ONLY]}).estimator.solver)
    file = rig_file(tmp_path, 'solver: appendix_d')
    assert main(['replay', str(BAG), '--params-file', file]) == 0
