# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The page that tries it in the browser, without a browser: what it computes, what it carries, what it rejects.

``make docs STEP=try-page`` runs it in Chromium.
"""

import base64
import hashlib
import io
import json
import re
import runpy
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

from psd_deflection.studies.study import StudyResult
from tools import pyodide_site, try_page
from tools.program import ROOT

pytestmark = pytest.mark.slow

WORK = pyodide_site.WORK
CHOICES = re.findall(
    r'<option value="([^"]+)" data-size="([\d.]+)" data-least="([\d.]+)" data-most="([\d.]+)" data-unit="[^"]+" '
    r'data-si="([\d.]+)">',
    (ROOT / 'docs' / 'try.md').read_text(),
)
NOT_THERE = ('aiohttp', 'cv2', 'fcntl', 'lz4', 'pandas', 'resource', 'ruamel', 'serial', 'termios', 'tqdm', 'zstandard')
"""What Python in the browser does not have here: neither the interpreter nor we bring it."""

SCRIPT = f"""
import runpy, sys
sys.modules.update(dict.fromkeys({NOT_THERE!r}))
runpy.run_path({str(WORK)!r})['run']('', 1, lambda kind, text: print(kind, len(text)))
"""

LEAST = [f'{words}={float(least) * float(si):.4g}' for words, _, least, _, si in CHOICES]


@pytest.mark.parametrize('effect', [LEAST[0], ''], ids=lambda effect: effect or 'nothing')
def test_the_least_that_can_be_hidden_is_named(effect: str, monkeypatch: pytest.MonkeyPatch) -> None:
    # It takes as long as the search.
    monkeypatch.setattr(StudyResult, 'report', lambda found: '')
    answers: list[str] = []
    runpy.run_path(str(WORK))['run'](effect, 1, lambda kind, text: answers.append(text) if kind == 'answer' else None)
    assert not try_page.wrong(effect or 'nothing', answers[0])


def test_it_needs_only_what_the_browser_has() -> None:
    done = subprocess.run([sys.executable, '-c', SCRIPT], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    reported = [line.split() for line in done.stdout.splitlines()]
    assert [kind for kind, _ in reported] == ['step', 'step', 'step', 'answer', 'step', 'report']
    assert int(reported[-1][1]) > 100_000


def test_every_choice_is_tried() -> None:
    text = (ROOT / 'docs' / 'try.md').read_text()
    assert len(CHOICES) >= 6
    assert text.count('<option ') == len(CHOICES) + 2
    assert all(float(least) <= float(usual) <= float(most) for _, usual, least, most, _ in CHOICES)


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """What the registries would give: an interpreter with its lock file, and a package with the wheel of it."""
    folder = tmp_path / 'cache'
    folder.mkdir()
    wheel = b'a wheel'
    lock = {
        'packages': {
            name: {'file_name': f'{name}.whl', 'sha256': hashlib.sha256(wheel).hexdigest(), 'depends': depends}
            for name, depends in (('numpy', []), ('scipy', ['numpy', 'blas']), ('blas', []))
        }
    }
    packed = folder / f'pyodide-{pyodide_site.VERSION}.tgz'
    with tarfile.open(packed, 'w:gz') as archive:
        for name in pyodide_site.INTERPRETER:
            data = json.dumps(lock).encode()
            member = tarfile.TarInfo(f'package/{name}')
            member.size = len(data)
            archive.addfile(member, io.BytesIO(data))
    digest = hashlib.sha512(packed.read_bytes()).digest()
    monkeypatch.setattr(pyodide_site, 'INTEGRITY', f'sha512-{base64.b64encode(digest).decode()}')
    carry(folder, dict.fromkeys(('numpy', 'scipy', 'blas'), wheel))
    return folder


def carry(cache: Path, wheels: dict[str, bytes]) -> None:
    name, version = pyodide_site.CARRIER.split('==')
    with zipfile.ZipFile(cache / f'{name.replace("-", "_")}-{version}-py3-none-any.whl', 'w') as archive:
        for wheel, data in wheels.items():
            archive.writestr(f'somewhere/{wheel}.whl', data)
        archive.writestr('somewhere/other.whl', b'not asked for')
