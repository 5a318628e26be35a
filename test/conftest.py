# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""No test asserts time, so hypothesis does not either; no test sees the effects of who runs it; shared judges."""

import os
from pathlib import Path

import pytest
from hypothesis import Phase, settings

from test.judges import Golden, RayPlane
from test.shaken import Shaker, shake

os.environ['PSD_DEFLECTION_EFFECTS'] = ''
SHAKER = pytest.StashKey[Shaker]()

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


def pytest_addoption(parser: pytest.Parser) -> None:
    """``--shaken``."""
    parser.addoption('--shaken', action='store_true', help='LAPACK answers a last bit off (test/shaken.py)')


def pytest_configure(config: pytest.Config) -> None:
    """Before any test imports numpy's functions by name."""
    if config.getoption('--shaken'):
        config.stash[SHAKER] = shake()


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
