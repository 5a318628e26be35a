# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from .serving import Serving

if TYPE_CHECKING:
    from .browsing import Page


@pytest.fixture(autouse=True)
def own_state(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where the pages of this test are announced: not among those of the user who runs it."""
    folder = tmp_path_factory.mktemp('state')
    monkeypatch.setenv('XDG_STATE_HOME', str(folder))
    return folder / 'psd_deflection'


@pytest.fixture
def serve(request: pytest.FixtureRequest) -> Callable[..., Serving]:
    def begin(**overrides: object) -> Serving:
        serving = Serving(overrides)
        request.addfinalizer(serving.server.close)
        return serving

    return begin


@pytest.fixture(scope='module')
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    """A browser."""
    # Imported here: only these tests need selenium.
    from .browsing import Page

    with contextlib.closing(Page(tmp_path_factory.mktemp('profile'))) as browser:
        yield browser
