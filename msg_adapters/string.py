# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""std_msgs/String: the rig as JSON, so that a recording of any recorder can be evaluated with it; and marks."""

import json
from collections.abc import Mapping
from typing import Any

from msg_adapters.header import Fields
from msg_adapters.message_type import MessageType
from psd_deflection.records import Mark, RigState

MESSAGE = MessageType(
    'std_msgs/msg/String', 'RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18', 'string data\n'
)

MAX_CHARACTERS = 16_000_000
"""Longest text that is parsed. Ours have some thousand characters, with what a pipeline remembers some ten thousand,
and some million if its blocks are long or its filter goes on for a minute without samples."""


LONGEST_MARK = 200
"""Characters of a mark."""


def from_mark(mark: Mark) -> Fields:
    """Fields of a mark; the message has no stamp, its arrival is the time."""
    return {'data': mark.text}


def to_mark(fields: Mapping[str, Any]) -> Mark:
    """The record of a mark, at time 0: the message has none. Raises ValueError for a text that is no mark."""
    text: str = fields['data']
    if not 0 < len(text.strip()) <= len(text) <= LONGEST_MARK:
        raise ValueError(f'a mark of {len(text)} characters: must be 1 to {LONGEST_MARK}, not only spaces')
    if not text.isprintable():
        raise ValueError('a mark with a control character: must be one line of printable characters')
    return Mark(0, text.strip())


def _plain(value: object) -> object:
    if isinstance(value, Mapping):
        return dict(value)
    raise TypeError(f'{type(value).__name__} {value!r} has no JSON')


def from_rig(state: RigState) -> Fields:
    """Fields of one state of the rig; ``zero`` repeats two of the parameters, for those who look for them."""
    tree = {
        'version': state.version,
        't_ns': state.t_ns,
        'block': state.block,
        'parameters': state.parameters,
        'zero': {psd: state.parameters.get(f'{psd}.zero') for psd in ('psd_1', 'psd_2')},
        'hello': state.hello,
        'changed': state.changed,
        'made_with': state.made_with,
    }
    if state.memory is not None:
        tree['memory'] = state.memory
    return {'data': json.dumps(tree, default=_plain)}


def to_rig(fields: Mapping[str, Any]) -> RigState:
    """The record of a message. Raises ValueError if it is not one of ours."""
    text = fields['data']
    if len(text) > MAX_CHARACTERS:
        raise ValueError(f'has {len(text)} characters, more than {MAX_CHARACTERS}')
    try:
        tree = json.loads(text)
    except RecursionError:
        raise ValueError('is nested too deeply') from None
    kinds = {'version': str, 't_ns': int, 'block': int, 'parameters': dict, 'changed': dict}
    if not isinstance(tree, dict) or not all(isinstance(tree.get(name), kind) for name, kind in kinds.items()):
        raise ValueError('lacks one of ' + ', '.join(kinds))
    hello, memory = (tree.get(name) if isinstance(tree.get(name), dict) else None for name in ('hello', 'memory'))
    reported = tree.get('made_with')
    made_with = reported.items() if isinstance(reported, dict) else ()
    return RigState(
        t_ns=tree['t_ns'],
        block=tree['block'],
        parameters=tree['parameters'],
        hello=hello,
        changed=tree['changed'],
        version=tree['version'],
        made_with={name: value for name, value in made_with if isinstance(value, str)},
        memory=memory,
    )
