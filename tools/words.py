# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Counts words that only this tree used in identifiers: ``python -m tools.words``; status 1 if any is left."""

from __future__ import annotations

import io
import re
import sys
import tokenize
from collections import Counter
from pathlib import Path

"""The word that is no longer used, and what the field writes."""
FINISHED = {
    'refused': 'rejected',
    'refuse': 'reject',
    'refuses': 'rejects',
    'refusal': 'rejection',
    'told': 'reported',
    'tells': 'reports',
    'seen': 'observed',
    'said': 'message',
}
"""Names of other people."""
FOREIGN = {'ConnectionRefusedError'}
ROOMS = ('psd_deflection', 'msg_adapters', 'launch', 'test', 'bench', 'blind', 'tools', 'bags')


def counted(text: str) -> Counter[str]:
    """Return the uses of each finished word in the identifiers of Python source ``text``."""
    names = (t.string for t in tokenize.generate_tokens(io.StringIO(text).readline) if t.type == tokenize.NAME)
    parts = (p.lower() for n in names if n not in FOREIGN for p in re.findall('[A-Z]+(?![a-z])|[A-Z]?[a-z]+', n))
    return Counter(p for p in parts if p in FINISHED)


if __name__ == '__main__':
    files = [path for room in ROOMS for path in Path(room).rglob('*.py')]
    uses = {path: counted(path.read_text()) for path in files}
    for path, words in uses.items():
        for word, count in words.items():
            print(f'{path}: {word}: {count} uses, write {FINISHED[word]}')
    sys.exit(any(uses.values()))
