"""No test asserts time, so hypothesis does not either; no test sees the effects of who runs it; shared judges."""

import os
from pathlib import Path

import pytest
from hypothesis import settings

from test.judges import Golden, RayPlane

os.environ['PSD_DEFLECTION_EFFECTS'] = ''

settings.register_profile('untimed', deadline=None)
settings.load_profile('untimed')


@pytest.fixture(scope='session')
def golden() -> Golden:
    """The answers of an independent audit of the thesis."""
    return Golden(Path(__file__).parent / 'data' / 'golden.json')


@pytest.fixture(scope='session')
def rays() -> RayPlane:
    """A simulator that shares no code with the package."""
    return RayPlane()
