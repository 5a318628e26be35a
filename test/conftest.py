# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Which tests run: tiers and rooms. Shared judges.

No test asserts time, so hypothesis does not either; no test sees the effects of who runs it.
"""

import os
import random
from pathlib import Path

import pytest
from hypothesis import Phase, settings

from test.oracles import Golden, RayPlane
from test.shaken import Shaker, shake
from tools.tiers import ROOMS, TIERS, holds, paths_of

os.environ['PSD_DEFLECTION_EFFECTS'] = ''
SHAKER = pytest.StashKey[Shaker]()

settings.register_profile('untimed', deadline=None)
# For `make mutants`: it asks only whether a test fails, each time of the same few examples.
settings.register_profile(
    'mutants', deadline=None, derandomize=True, database=None, phases=(Phase.explicit, Phase.generate), max_examples=30
)
settings.load_profile('mutants' if 'PSD_DEFLECTION_MUTANTS' in os.environ else 'untimed')


ROOT = Path(__file__).parents[1]


def pytest_addoption(parser: pytest.Parser) -> None:
    """``--shaken``, ``--tier``, ``--order`` and ``--room``."""
    parser.addoption('--shaken', action='store_true', help='LAPACK answers a last bit off (test/shaken.py)')
    parser.addoption('--tier', choices=(*TIERS, 'all'), default='all', help='quick: not marked slow (default all)')
    parser.addoption('--order', type=int, metavar='SEED', help='shuffle the tests: none may depend on another')
    parser.addoption('--room', help='the tests of this folder of test/, or of this room of tools/tiers.py, alone')


def pytest_configure(config: pytest.Config) -> None:
    """Before any test imports numpy's functions by name."""
    if config.getoption('--shaken'):
        config.stash[SHAKER] = shake()
    room = config.getoption('--room')
    if room and room not in ROOMS and not (ROOT / 'test' / room).is_dir():
        folders = [path.name for path in (ROOT / 'test').iterdir() if path.is_dir()]
        raise pytest.UsageError(f'--room: there is no room {room!r}; {", ".join(sorted({*folders, *ROOMS}))}')


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Files of other rooms are not even imported."""
    room = config.getoption('--room')
    if not room or collection_path.suffix != '.py':
        return None
    file = str(collection_path.relative_to(ROOT))
    return None if holds(paths_of(room), file) else True


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out what is of another tier; a module's fixture is made by one worker."""
    tier = config.getoption('--tier')
    if tier != 'all':
        chosen = [(item.get_closest_marker('slow') is not None) == (tier == 'slow') for item in items]
        config.hook.pytest_deselected(items=[item for item, its in zip(items, chosen, strict=True) if not its])
        items[:] = [item for item, its in zip(items, chosen, strict=True) if its]
    if config.getoption('--order') is not None:
        random.Random(config.getoption('--order')).shuffle(items)
    # xdist says so in its workers.
    grouped = items if getattr(config.option, 'loadgroup', False) else []
    for item in grouped:
        if isinstance(item, pytest.Function):
            scopes = {fixture.scope for made in item._fixtureinfo.name2fixturedefs.values() for fixture in made}
            if 'module' in scopes:
                item.add_marker(pytest.mark.xdist_group(item.nodeid.partition('::')[0]))


def pytest_runtest_setup(item: pytest.Item) -> None:
    """A failure comes back if its test runs alone."""
    if SHAKER in item.config.stash:
        repeatable = item.get_closest_marker('repeatable') is not None
        item.config.stash[SHAKER].begin(item.nodeid, repeatable=repeatable)


@pytest.fixture(scope='session')
def golden() -> Golden:
    """The answers of an independent audit of the thesis."""
    return Golden(Path(__file__).parent / 'data' / 'golden.json')


@pytest.fixture(scope='session')
def rays() -> RayPlane:
    """A simulator that shares no code with the package."""
    return RayPlane()
