# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What a view needs is said before it is started."""

from __future__ import annotations

import pytest

from psd_deflection.base.errors import ConfigError
from psd_deflection.run.monitor.served import need_server


@pytest.mark.parametrize('version', ['3.9.0', '3.14.5', '4.0.0a1', '10.0'])
def test_a_library_that_is_new_enough_is_taken(monkeypatch: pytest.MonkeyPatch, version: str) -> None:
    monkeypatch.setattr('importlib.metadata.version', lambda _: version)
    need_server()


@pytest.mark.parametrize('version', ['3.8.4', '2.99.0'])
def test_outdated_library_is_rejected_by_version(monkeypatch: pytest.MonkeyPatch, version: str) -> None:
    monkeypatch.setattr('importlib.metadata.version', lambda _: version)
    with pytest.raises(ConfigError, match=rf'needs aiohttp 3\.9 or later, {version} is installed'):
        need_server()
