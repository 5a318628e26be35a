# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Counts words that only this tree used in identifiers: ``python -m tools.words``; status 1 if any is left."""

import io
import re
import sys
import tokenize
from collections import Counter
from pathlib import Path

# The word that is no longer used, and what the field writes.
_WORDS = """
refused:rejected refuse:reject refuses:rejects refusal:rejection told:reported tells:reports seen:observed said:message
hung:applied noted:annotated unnoted:unannotated acted:effective mended:corrected wire:sink wires:sinks say:log
says:description unsaid:significant ear:probe ears:probes hear:feed rival:alternative rivals:alternatives
lattice:value_grid gathered:buffered foretold:predicted coasts:predictions_only suspect:candidate suspects:candidates
judge:classify judges:classifies judged:classified whole:full freed:with_free turned:rotated
"""
# These only as the whole of an identifier.
_EXACT = """
found:result one:item own:local kept:selected left:residual turn:rotation turns:rotations by:by_name others:peers
near:close far:distant plateau:hold plateaus:holds some:subset counted:count beyond:excess misfit:state_mismatch
due:next_time settled:converged behind:lag walk:random_walk restore:load_state_dict little:small spread:sd tell:notify
wander:random_walk much:share
"""
FINISHED, EXACT = (dict(re.findall(r'(\w+):(\w+)', words)) for words in (_WORDS, _EXACT))
# Names of other people: all of them, or what is before the name or after it.
FOREIGN = {'ConnectionRefusedError', '.walk', '.tell', '.by', 'left=', 'kept='}
# A test's name is a sentence in plain words.
SENTENCE = re.compile('test_[a-z0-9]+_[a-z0-9]+_[a-z0-9_]+')
ROOMS = ('psd_deflection', 'msg_adapters', 'launch', 'test', 'bench', 'blind', 'tools', 'bags')


def uses_of(text: str) -> Counter[str]:
    """Return the uses of each finished word in the identifiers of Python source ``text``."""
    tokens = [t for t in tokenize.generate_tokens(io.StringIO(text).readline) if t.type == tokenize.NAME]
    around = [(t.string, t.line[t.start[1] - 1 : t.end[1]], t.line[t.start[1] : t.end[1] + 1]) for t in tokens]
    names = [name for name, before, after in around if not FOREIGN & {name, before, after}]
    parts = (
        p.lower() for n in names if not SENTENCE.fullmatch(n) for p in re.findall('[A-Z]+(?![a-z])|[A-Z]?[a-z]+', n)
    )
    # Beside what is right, left is a side.
    exact = EXACT.keys() - ({'left'} if 'right' in names else set())
    return Counter(p for p in parts if p in FINISHED) + Counter(n for n in names if n in exact)


if __name__ == '__main__':
    files = [path for room in ROOMS for path in Path(room).rglob('*.py')]
    uses = {path: uses_of(path.read_text()) for path in files}
    for path, words in uses.items():
        for word, count in words.items():
            print(f'{path}: {word}: {count} uses, write {(FINISHED | EXACT)[word]}')
    sys.exit(any(uses.values()))
