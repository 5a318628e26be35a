# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A checkout of ros/rosdistro, for rosdep and bloom on this machine; and our table of keys against it."""

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
import xml.etree.ElementTree
from pathlib import Path

import yaml

from tools.release import ROOT, rosdep_table

SYSTEMS = {'noble': ('ubuntu', 'jazzy'), 'resolute': ('ubuntu', 'lyrical'), 'bookworm': ('debian', 'jazzy')}
"""Columns of the table: the system, and the distribution of ROS whose packages it has."""
LOOK_UP = """
import json, sys
from rosdep2.installers import InstallerContext
from rosdep2.lookup import RosdepLookup, ResolutionError
from rosdep2.main import create_default_installer_context
from rosdep2.rospkg_loader import DEFAULT_VIEW_KEY
from rosdep2.sources_list import SourcesListLoader
system, version, keys = sys.argv[1], sys.argv[2], sys.argv[3:]
context = create_default_installer_context()
context.set_os_override(system, version)
lookup = RosdepLookup.create_from_rospkg(sources_loader=SourcesListLoader.create_default(os_override=(system, version)))
view = lookup.get_rosdep_view(DEFAULT_VIEW_KEY)
installers, usual = context.get_os_installer_keys(system), context.get_default_os_installer_key(system)
found = {}
for key in keys:
    try:
        found[key] = view.lookup(key).get_rule_for_platform(system, version, installers, usual)[0]
    except (KeyError, ResolutionError):
        found[key] = 'none'
print(json.dumps(found))
"""
"""By the key: its installer on one system, as rosdep has it."""


def our_rows(root: Path) -> str:
    """The lines to submit, of packaging/rosdistro.md."""
    match = re.search(r'^```yaml\n(.+?)^```', (root / 'packaging/rosdistro.md').read_text(), re.M | re.S)
    if match is None:
        raise ValueError('packaging/rosdistro.md: no block of yaml')
    return match[1]


def written(rosdistro: Path, into: Path, ours: str = '', root: Path = Path('/')) -> dict[str, str]:
    """What rosdep and bloom read the rows ``ours``, then ``rosdistro`` by, seen from ``root``. Fills ``into``."""

    def url(path: Path) -> str:
        return f'file:///{path.resolve().relative_to(root.resolve())}'

    lists = into / 'sources'
    lists.mkdir(parents=True)
    if ours:
        (into / 'ours.yaml').write_text(ours)
        (lists / '10-ours.list').write_text(f'yaml {url(into / "ours.yaml")}\n')
    files = [f'yaml {url(rosdistro / "rosdep" / name)}.yaml\n' for name in ('base', 'python', 'ruby')]
    (lists / '20-default.list').write_text(''.join(files))
    index = yaml.safe_load((rosdistro / 'index-v4.yaml').read_text())
    wanted = {ros for _, ros in SYSTEMS.values()}
    index['distributions'] = {name: index['distributions'][name] for name in sorted(wanted)}
    for name, entry in index['distributions'].items():
        # The cache of the build farm is not in the checkout; rosdep needs of it what the distribution's file has.
        source = rosdistro / name / 'distribution.yaml'
        content = yaml.load(source.read_text(), getattr(yaml, 'CSafeLoader', yaml.SafeLoader))
        cache = {'name': name, 'type': 'cache', 'version': 2, 'distribution_file': [content]}
        text = json.dumps({**cache, 'release_package_xmls': {}, 'source_repo_package_xmls': {}}, default=str)
        (into / f'{name}-cache.yaml').write_text(text)
        entry.update(distribution=[url(source)], distribution_cache=f'{name}-cache.yaml')
    (into / 'index-v4.yaml').write_text(yaml.safe_dump(index))
    return {'ROSDEP_SOURCE_PATH': url(lists)[7:], 'ROSDISTRO_INDEX_URL': url(into / 'index-v4.yaml')}


def prepared(rosdistro: Path, tools: Path, into: Path, ours: str = '') -> dict[str, str]:
    """The environment with which rosdep and bloom on this machine read what ``written`` writes."""
    path = f'{(tools / "bin").absolute()}{os.pathsep}{os.environ["PATH"]}'
    homes = {'HOME': str(into), 'ROS_HOME': str(into / 'ros')}
    env = {**os.environ, **written(rosdistro, into, ours), **homes, 'PATH': path}
    subprocess.run([tools / 'bin/rosdep', 'update'], env=env, check=True, capture_output=True)
    return env


def resolved(env: dict[str, str], tools: Path, keys: list[str]) -> dict[str, dict[str, str]]:
    """By the key, then by the column: apt, pip or none."""
    rows: dict[str, dict[str, str]] = {key: {} for key in keys}
    for version, (system, ros) in SYSTEMS.items():
        command = [str(tools / 'bin/python'), '-c', LOOK_UP, system, version, *keys]
        here = {**env, 'ROS_DISTRO': ros}
        message = subprocess.run(command, env=here, check=True, capture_output=True, text=True).stdout
        for key, how in json.loads(message.splitlines()[-1]).items():
            rows[key][version] = how
    return rows


def differences(table: dict[str, dict[str, str]], rosdep: dict[str, dict[str, str]]) -> list[str]:
    """Where the table says otherwise than rosdep."""
    return [
        f'packaging/rosdep_keys.csv: {key} on {version} is {message}, rosdep says {rosdep[key][version]}'
        for key, row in table.items()
        for version, message in row.items()
        if rosdep[key][version] != message
    ]


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('rosdistro', type=Path)
    parser.add_argument('--tools', type=Path, default=ROOT / 'build/bloom', help='environment with rosdep')
    options, table = parser.parse_args(argv), rosdep_table(ROOT)
    package = xml.etree.ElementTree.parse(ROOT / 'package.xml').getroot()
    needed = [e.text or '' for e in package if e.tag.endswith('depend')]
    problems: list[str] = []
    for ours in ('', our_rows(ROOT)):
        with tempfile.TemporaryDirectory() as folder:
            env = prepared(options.rosdistro, options.tools, Path(folder), ours)
            rosdep = resolved(env, options.tools, list(dict.fromkeys([*table, *needed])))
        if not ours:
            problems += differences(table, rosdep)
            none = sorted({key for key in needed if 'none' in rosdep[key].values()})
            print(f'{len(needed)} keys of package.xml; without a row somewhere: {", ".join(none) or "none"}')
        else:
            missing = [f'{key} on {v}: {how}' for key in needed for v, how in rosdep[key].items() if how != 'apt']
            problems += [f'with packaging/rosdistro.md: {line}' for line in missing]
            print(
                f'with the lines of packaging/rosdistro.md: {len(missing)} of {len(needed)} keys do not resolve by apt'
            )
    for line in problems:
        print(f'PROBLEM: {line}')
    return 1 if problems else 0


if __name__ == '__main__':
    sys.exit(main())
