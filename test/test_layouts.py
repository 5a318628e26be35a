# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The layouts of Foxglove, PlotJuggler and RViz and the SROS 2 policy name what there is."""

import json
import re
import xml.etree.ElementTree
from pathlib import Path
from typing import Any

import pytest
import yaml

from msg_adapters import DIAGNOSTICS, INPUTS, TOPIC_TYPES
from psd_deflection.recordings import cdr
from psd_deflection.recordings.read.readers import open_recording
from psd_deflection.ros import topics as table
from psd_deflection.ros.topics import BASE, SERVICES

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parent.parent
CONFIG = ROOT / 'config'


@pytest.fixture(scope='module')
def recorded() -> dict[str, Any]:
    """One message of each topic of a recording, decoded."""
    found: dict[str, Any] = {}
    for message in open_recording(ROOT / 'bags' / 'clean').messages():
        if message.channel.topic not in found:
            found[message.channel.topic] = cdr.decode(message.channel.type, message.cdr)
    return found


def field_of(fields: Any, path: str) -> float:
    for name in re.findall(r'\w+', path):
        fields = fields[int(name)] if name.isdigit() else fields[name]
    assert isinstance(fields, float)
    return fields


def test_foxglove(recorded: dict[str, Any]) -> None:
    layout = json.loads((CONFIG / 'foxglove_layout.json').read_text())
    panels = layout['configById']
    paths = [p['value'] for panel in panels.values() for p in panel.get('paths', [])]
    assert len(paths) > 10
    for path in paths:
        topic, _, field = path.partition('.')
        assert topic in recorded, path
        field_of(recorded[topic], field)
    stamped = [p for panel in panels.values() for p in panel.get('paths', []) if p['timestampMethod'] == 'headerStamp']
    assert all('stamp' in recorded[p['value'].partition('.')[0]]['header'] for p in stamped)
    # A bag that was simulated has no diagnostics; one that was recorded has.
    assert DIAGNOSTICS in TOPIC_TYPES
    topics = [p[key] for p in panels.values() for key in ('topicPath', 'topicToRender') if key in p]
    assert set(topics) <= {*recorded, DIAGNOSTICS}

    def leaves(node: Any) -> list[str]:
        return [node] if isinstance(node, str) else [*leaves(node['first']), *leaves(node['second'])]

    assert sorted(leaves(layout['layout'])) == sorted(panels)


def test_plotjuggler(recorded: dict[str, Any]) -> None:
    root = xml.etree.ElementTree.parse(CONFIG / 'plotjuggler_layout.xml').getroot()
    made = {snippet.get('name') for snippet in root.iter('snippet')}
    names = [str(c.get('name')) for c in root.iter('curve')]
    sources = [str(s.text) for s in root.iter('linked_source')]
    assert len(names) > 10
    for name in [*(n for n in names if n not in made), *sources]:
        (topic,) = [t for t in recorded if name.startswith(t + '/')]
        field_of(recorded[topic], name.removeprefix(topic))
    for splitter in root.iter('DockSplitter'):
        assert int(str(splitter.get('count'))) == len(splitter) == len(str(splitter.get('sizes')).split(';'))


def test_rviz() -> None:
    tree = yaml.safe_load((CONFIG / 'link_tip.rviz').read_text())
    displays = [d for d in tree['Visualization Manager']['Displays'] if d['Class'].endswith('MarkerArray')]
    assert {d['Topic']['Value'] for d in displays} == {table.MARKERS, table.MARKERS_AT_REST}
    assert tree['Visualization Manager']['Global Options']['Fixed Frame'] == BASE
    # A subscriber that asks for more than the publisher gives is not connected at all.
    for topic in (d['Topic'] for d in displays):
        given = table.PUBLISHED[topic['Value']].delivery
        assert topic['Durability Policy'] == ('Transient Local' if given.latched else 'Volatile')
        assert topic['Reliability Policy'] == 'Reliable'
        assert given.reliable


def test_the_sros2_policy() -> None:
    root = xml.etree.ElementTree.parse(CONFIG / 'sros2_policy.xml').getroot()
    enclaves = {str(e.get('path')): e for e in root.iter('enclave')}
    assert sorted(enclaves) == ['/psd/estimator', '/psd/operator', '/psd/viewer']
    of_every_node = {'/rosout', '/parameter_events'}
    topics = {t.text for t in root.iter('topic')} - of_every_node - {'*', '/link_tip/*'}
    assert topics <= {*TOPIC_TYPES, table.TF, table.TF_STATIC}
    assert topics >= set(INPUTS)
    served = {name.replace('~', '/estimator') for name in SERVICES}
    requested = {
        path: {s.text for g in e.iter('services') if 'request' in g.attrib for s in g} for path, e in enclaves.items()
    }
    assert requested == {'/psd/estimator': set(), '/psd/operator': served, '/psd/viewer': set()}
    for path in ('/psd/operator', '/psd/viewer'):
        published = {t.text for g in enclaves[path].iter('topics') if 'publish' in g.attrib for t in g}
        assert published == of_every_node
