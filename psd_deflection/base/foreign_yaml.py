# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Reads YAML that a stranger may have written: parameter files, ``metadata.yaml``, lists and inputs.

Only plain types come out (maps, lists, text, numbers, dates), and only as much as was allowed for: a few hundred bytes
of aliases or merge keys can stand for more than any memory holds, and some tags make the parser itself fail.
"""

import functools
import io
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import yaml

from psd_deflection.base.errors import ConfigError

MAX_FILE_BYTES = 1_000_000
MAX_DEPTH = 50
MAX_NODES = 50_000
"""Keys, values, lists and maps of one file, each counted as often as aliases and merge keys repeat it."""

MAX_SCALAR = 200
"""Characters of a number, a date or what else is no text. A text may have any length."""

_TEXT = 'tag:yaml.org,2002:str'
_MERGE = 'tag:yaml.org,2002:merge'
_Loader: type[yaml.SafeLoader] = getattr(yaml, 'CSafeLoader', yaml.SafeLoader)


class YamlError(ValueError):
    """What is wrong, in a few words. ``where``: ``:line:column`` to put behind the file's name, or ''."""

    def __init__(self, problem: str, mark: Any = None) -> None:
        super().__init__(problem)
        self.where = f':{mark.line + 1}:{mark.column + 1}' if mark is not None else ''


def tree_of_file(path: Path, what: str, most: int = MAX_FILE_BYTES) -> object:
    """The tree of a YAML file, None for an empty one. Raises ConfigError as the two functions below do."""
    return tree_of_text(text_of_file(path, what, most), path)


def text_of_file(path: Path, what: str, most: int = MAX_FILE_BYTES) -> str:
    """The text of a file that ought to be a ``what`` (``parameter file``).

    Raises ConfigError naming the file if it is missing, cannot be read, has more than ``most`` bytes or is no text.
    """
    try:
        return read_text(path, most)
    except FileNotFoundError:
        raise ConfigError(f'{path}: no such {what}') from None
    except OSError as error:
        raise ConfigError(f'{path}: cannot be read as a {what} ({error.strerror or error})') from None
    except YamlError as error:
        raise ConfigError(f'{path}: cannot be read as a {what} ({error})') from None


def tree_of_text(text: str, path: Path) -> object:
    """The tree of the text of the file ``path``.

    Raises ConfigError naming file, line and column; also for a key that is in one map twice.
    """
    try:
        return parse_yaml(text, unique=True)
    except YamlError as error:
        raise ConfigError(f'{path}{error.where}: {error}') from None


def read_text(path: Path, most: int) -> str:
    """The UTF-8 text of a file of at most ``most`` bytes, whatever its size is said to be.

    Raises OSError, YamlError for a longer file and for one that is no text.
    """
    with path.open('rb') as stream:
        content = stream.read(most + 1)
    if len(content) > most:
        raise YamlError(f'it has more than {most} bytes')
    try:
        return content.decode('utf-8')
    except UnicodeDecodeError:
        raise YamlError('it is no text') from None


def parse_yaml(text: str, *, unique: bool = False) -> object:
    """The tree of one YAML document, None for an empty one. Raises YamlError.

    ``unique``: a key that is in one map twice is rejected; otherwise the last one holds.
    """
    try:
        _count(text)
        loader = _Loader(text)
        try:
            root = loader.get_single_node()
            if root is None:
                return None
            _measure(root, {}, set())
            if unique:
                _reject_doubles(root)
            return loader.construct_document(root)
        finally:
            loader.dispose()
    except YamlError:
        raise
    except yaml.MarkedYAMLError as error:
        raise YamlError(f'malformed YAML: {error.problem or "not YAML"}', error.problem_mark) from None
    except Exception:
        raise YamlError('malformed YAML: not YAML') from None


def edited(text: str, edit: Callable[[Any], None]) -> str:
    """``text`` after ``edit`` has changed its tree; comments, order and quotes of the rest are kept.

    Raises YamlError if :func:`parse_yaml` rejects the text, or if it can be read but not written again.
    """
    parse_yaml(text)
    # Imported here: it is slow, and only who writes a file of a user again needs it.
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    # Its round-trip loader makes no objects of tags, and does not write aliases out.
    writer = YAML(typ='rt')
    writer.preserve_quotes = True
    writer.width = 10_000
    writer.Representer = _exact()
    out = io.StringIO()
    try:
        tree = writer.load(text)
        edit(tree)
        writer.dump(tree, out)
    except (YAMLError, ValueError, TypeError, IndexError, RecursionError) as error:
        raise YamlError(f'cannot be written again ({type(error).__name__})') from None
    return out.getvalue()


@functools.cache
def _exact() -> Any:
    """How a tree is written: a number that its own notation would round is written with all its digits."""
    from ruamel.yaml.representer import RoundTripRepresenter
    from ruamel.yaml.scalarfloat import ScalarFloat

    class Exact(RoundTripRepresenter):
        def represent_scalar_float(self, data: Any) -> Any:
            if data == 0.0 and math.copysign(1.0, data) < 0.0:
                # ruamel.yaml cannot write -0e+00.
                zero = ScalarFloat(0.0)
                zero.__dict__.update(vars(data), _m_sign=False)
                node = super().represent_scalar_float(zero)
                node.value = f'-{node.value}'
                return node
            node = super().represent_scalar_float(data)
            if float(node.value) != float(data):
                digits = repr(float(data))
                # YAML 1.1 takes a number without a point for a word.
                node.value = digits if '.' in digits else digits.replace('e', '.0e')
            return node

    Exact.add_representer(ScalarFloat, Exact.represent_scalar_float)
    return Exact


def _count(text: str) -> None:
    """Reject what is too large or nested too deep before anything of it is built."""
    nodes = depth = 0
    for event in yaml.parse(text, Loader=_Loader):
        if isinstance(event, yaml.NodeEvent):
            nodes += 1
        if isinstance(event, yaml.CollectionStartEvent):
            depth += 1
        elif isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
        if depth > MAX_DEPTH:
            raise YamlError(f'malformed YAML: nested deeper than {MAX_DEPTH}', event.start_mark)
        if nodes > MAX_NODES:
            raise YamlError(f'malformed YAML: more than {MAX_NODES} keys and values', event.start_mark)


def _reject_doubles(root: yaml.Node) -> None:
    """Reject a key that is in one map twice: one of its values would be lost without a word. Merge keys may repeat."""
    observed: set[int] = set()
    waiting = [root]
    while waiting:
        node = waiting.pop()
        if id(node) in observed or isinstance(node, yaml.ScalarNode):
            continue
        observed.add(id(node))
        if not isinstance(node, yaml.MappingNode):
            waiting += node.value
            continue
        lines: dict[tuple[str, str], int] = {}
        for key, value in node.value:
            waiting += key, value
            if not isinstance(key, yaml.ScalarNode) or key.tag == _MERGE:
                continue
            line = key.start_mark.line + 1
            if (key.tag, key.value) in lines:
                first = lines[key.tag, key.value]
                raise YamlError(f'{key.value[:MAX_SCALAR]} is there twice, in lines {first} and {line}', key.start_mark)
            lines[key.tag, key.value] = line


def _measure(node: yaml.Node, known: dict[int, int], inside: set[int]) -> int:
    """How many nodes ``node`` stands for once every alias is written out.

    An alias stands behind what it repeats, so that this goes no deeper than the text is nested.
    """
    if id(node) in known:
        return known[id(node)]
    if id(node) in inside:
        raise YamlError('malformed YAML: an alias to what it stands in', node.start_mark)
    size = 1
    if isinstance(node, yaml.ScalarNode):
        if node.tag != _TEXT and len(node.value) > MAX_SCALAR:
            raise YamlError(f'malformed YAML: a number of {len(node.value)} characters', node.start_mark)
    else:
        inside.add(id(node))
        children = [n for pair in node.value for n in pair] if isinstance(node, yaml.MappingNode) else node.value
        for child in children:
            size += _measure(child, known, inside)
            if size > MAX_NODES:
                raise YamlError(
                    f'malformed YAML: aliases stand for more than {MAX_NODES} keys and values', node.start_mark
                )
        inside.discard(id(node))
    known[id(node)] = size
    return size
