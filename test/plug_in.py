# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Installs a made-up package into a folder that this process and those that it starts look into."""

import sys
from pathlib import Path

import pytest


def install_plug_in(folder: Path, monkeypatch: pytest.MonkeyPatch, module: str, code: str, entry_points: str) -> None:
    """``my_package`` with ``module`` of ``code``, and the text of its ``entry_points``."""
    package = folder / 'my_package'
    package.mkdir()
    (package / '__init__.py').touch()
    (package / f'{module}.py').write_text(code)
    about = folder / 'my_package-1.0.dist-info'
    about.mkdir()
    (about / 'METADATA').write_text('Metadata-Version: 2.1\nName: my_package\nVersion: 1.0\n')
    (about / 'entry_points.txt').write_text(entry_points)
    monkeypatch.syspath_prepend(folder)
    for name in ('my_package', f'my_package.{module}'):
        monkeypatch.delitem(sys.modules, name, raising=False)
    monkeypatch.setenv('PYTHONPATH', str(folder))
