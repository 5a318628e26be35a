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

from test.judges import Golden, RayPlane
from test.shaken import Shaker, shake
from tools.tiers import ROOMS, TIERS, chooses, entries_of, tier_of

os.environ['PSD_DEFLECTION_EFFECTS'] = ''
SHAKER = pytest.StashKey[Shaker]()
COLLECTED = pytest.StashKey[dict[str, bool]]()
"""Each test that was found, of any tier, and whether it is marked ``statistics``."""

settings.register_profile('untimed', deadline=None)
# For `make mutants`: it asks only whether a test fails, each time of the same few examples.
settings.register_profile(
    'mutants',
    deadline=None,
    derandomize=True,
    database=None,
    phases=(Phase.explicit, Phase.generate),
    max_examples=30,
)
settings.load_profile('mutants' if 'PSD_DEFLECTION_MUTANTS' in os.environ else 'untimed')


ROOT = Path(__file__).parents[1]


def pytest_addoption(parser: pytest.Parser) -> None:
    """``--shaken``, ``--tier``, ``--order`` and ``--room``."""
    parser.addoption('--shaken', action='store_true', help='LAPACK answers a last bit off (test/shaken.py)')
    parser.addoption('--tier', choices=(*TIERS, 'all'), default='all', help='of tools/tiers.py (default all)')
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
    return None if any(chooses(entry.partition(' ')[0], file) for entry in entries_of(room)) else True


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out what is of another tier or room; a module's fixture is made by one worker."""
    tier, room = config.getoption('--tier'), config.getoption('--room')
    entries = entries_of(room) if room else ('test',)
    found = {item.nodeid: item.get_closest_marker('statistics') is not None for item in items}
    config.stash[COLLECTED] = found
    chosen = {
        name
        for name, marked in found.items()
        if tier in ('all', tier_of(name, marked)) and any(chooses(entry, name) for entry in entries)
    }
    config.hook.pytest_deselected(items=[item for item in items if item.nodeid not in chosen])
    items[:] = [item for item in items if item.nodeid in chosen]
    if config.getoption('--order') is not None:
        random.Random(config.getoption('--order')).shuffle(items)
    # xdist says so in its workers.
    grouped = items if getattr(config.option, 'loadgroup', False) else []
    for item in grouped:
        if isinstance(item, pytest.Function):
            scopes = {one.scope for made in item._fixtureinfo.name2fixturedefs.values() for one in made}
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
