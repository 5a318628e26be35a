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
    messages: dict[str, Any] = {}
    for message in open_recording(ROOT / 'bags' / 'clean').messages():
        if message.channel.topic not in messages:
            messages[message.channel.topic] = cdr.decode(message.channel.type, message.cdr)
    return messages


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


def test_an_analyzer_takes_each_part_of_the_diagnostics() -> None:
    (tree,) = yaml.safe_load((CONFIG / 'diagnostics.yaml').read_text()).values()
    analyzers = [a for a in tree['ros__parameters'].values() if isinstance(a, dict)]
    assert {a['type'] for a in analyzers} == {'diagnostic_aggregator/GenericAnalyzer'}
    files = [path for room in ('run', 'ros') for path in (ROOT / 'psd_deflection' / room).glob('*.py')]
    parts = {part for path in files for part in re.findall(r"'psd_deflection: (\w+)", path.read_text())}
    starts = [start for a in analyzers for start in a['startswith']]
    assert {part: [s for s in starts if f'estimator: {part}'.startswith(s)] for part in parts} == {
        part: [f'estimator: {part}'] for part in parts
    }
    assert len(starts) == len(parts) > 7


def test_the_xacro_macro_hangs_the_link_on_a_robot(tmp_path: Path) -> None:
    xacro = pytest.importorskip('xacro')
    robot = tmp_path / 'robot.urdf.xacro'
    robot.write_text(f"""<robot name="arm" xmlns:xacro="http://www.ros.org/wiki/xacro">
      <link name="tool0"/>
      <xacro:include filename="{CONFIG}/psd_link.urdf.xacro"/>
      <xacro:psd_link parent="tool0" prefix="left_" length="0.8"><origin xyz="0 0 0.1"/></xacro:psd_link>
    </robot>""")
    urdf = xml.etree.ElementTree.fromstring(xacro.process_file(str(robot)).toxml())
    joint = urdf.find('joint')
    assert joint is not None
    assert [(e.tag, *e.attrib.values()) for e in joint] == [
        *(('parent', 'tool0'), ('child', f'left_{BASE}'), ('origin', '0 0 0.1'))
    ]
    assert urdf.findall(f"link[@name='left_{BASE}']/visual/origin")[0].get('xyz') == '0 0 0.4'


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
