# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The file of a chain: its links with their rig files, ports, mounts and joints.

::

    slopes: end_force                # the default, or ratio
    base_frame: base_link
    frame_prefix: left_              # before the name of each frame
    links:
      - name: upper
        rig: upper.yaml              # a rig file, beside this file; without it the default rig
        port: /dev/psd_upper         # without it a simulated rig
        parameters: {solver: wls}    # over the rig file
        mount: {xyz: [0, 0, 0.1], rpy: [0, 0, 0]}
        joint: {name: shoulder, axis: [0, 0, 1], angle: 0.0}
        slope_ratio_sd: 0.1
    end_effector: {xyz: [0, 0, 0.1], rpy: [0, 0, 0]}

Lengths in m, angles in rad.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from psd_deflection.arms.chains.chain import SLOPES, Chain, ChainLink
from psd_deflection.arms.chains.transform import Transform, of_position_and_angles
from psd_deflection.base.errors import ConfigError
from psd_deflection.base.foreign_yaml import tree_of_file
from psd_deflection.base.text import did_you_mean
from psd_deflection.model.link.statics import LinkStatics
from psd_deflection.rig.config import Rig, replace_values, rig_from_values
from psd_deflection.rig.declarations import FRAME_PREFIX
from psd_deflection.rig.parameter_files import flattened, read_parameter_file
from psd_deflection.rig.parameters import Section, parameter

MOST_LINKS = 32
BASE_FRAME = 'base_link'
T = TypeVar('T')
LARGEST = 1000.0
"""Largest length, m, and angle, rad."""

_WITHIN: Mapping[str, Any] = {'minimum': -LARGEST, 'maximum': LARGEST}


NO_CHAIN = 'chain: a chain file must be named'


@dataclass(frozen=True, slots=True)
class ChainSettings:
    """What the file says of the chain as a whole; the node has it as ROS parameters."""

    slopes: str = parameter(SLOPES[0], '', 'where the tilts of the tips come from', choices=SLOPES)
    base_frame: str = parameter(BASE_FRAME, '', "name of the frame of the chain's base, without the prefix")
    frame_prefix: str = parameter('', '', 'put before the name of each frame, to distinguish two chains')

    def __post_init__(self) -> None:
        if not re.fullmatch(r'\w[\w/]{0,99}', self.base_frame):
            raise ConfigError(f'base_frame = {self.base_frame!r}: must be the name of a frame')
        if not re.fullmatch(r'[\w/]{0,100}', self.frame_prefix):
            raise ConfigError(f'frame_prefix = {self.frame_prefix!r}: must be the begin of the name of a frame')


@dataclass(frozen=True, slots=True)
class Joint:
    """The joint before a link. ``name``: in joint states, '' if none tells it; ``angle``: until one does."""

    name: str = parameter('', '', 'name of the joint in joint states')
    axis: tuple[float, float, float] = parameter((0.0, 0.0, 1.0), '', 'in the mounted frame', **_WITHIN)
    angle: float = parameter(0.0, 'rad', 'until joint states tell another', **_WITHIN)

    def __post_init__(self) -> None:
        if not any(self.axis):
            raise ConfigError('axis: must not be zero')


@dataclass(frozen=True, slots=True)
class _LinkEntry:
    name: str = parameter('', '', 'namespace of the topics, and with _ prefix of the frames')
    rig: str = parameter('', '', 'rig file, beside the chain file; empty: the default rig')
    port: str = parameter('', '', 'serial port; empty: that of the rig file, or a simulated rig')
    slope_ratio_sd: float = parameter(0.0, '', 'standard deviation of the slope ratio', minimum=0.0, maximum=LARGEST)

    def __post_init__(self) -> None:
        if not re.fullmatch(r'[a-z][a-z0-9_]{0,39}', self.name):
            raise ConfigError(f'name = {self.name!r}: must be a lower-case letter, then letters, digits and _')


@dataclass(frozen=True, slots=True)
class _Place:
    xyz: tuple[float, float, float] = parameter((0.0, 0.0, 0.0), 'm', 'position', **_WITHIN)
    rpy: tuple[float, float, float] = parameter((0.0, 0.0, 0.0), 'rad', 'roll, pitch and yaw', **_WITHIN)


SETTINGS = Section(ChainSettings)
JOINT, LINK, _PLACE = Section(Joint), Section(_LinkEntry), Section(_Place)


@dataclass(frozen=True, slots=True, eq=False)
class ChainFile:
    """``rigs`` and ``joints`` in the order of the links of ``chain``."""

    chain: Chain
    rigs: tuple[Rig, ...]
    joints: tuple[Joint, ...]
    settings: ChainSettings = ChainSettings()

    @property
    def names(self) -> tuple[str, ...]:
        """Of the links."""
        return tuple(link.name for link in self.chain.links)

    @property
    def angles(self) -> tuple[float, ...]:
        """Of the joints, as the file has them, rad."""
        return tuple(joint.angle for joint in self.joints)

    @property
    def base_frame(self) -> str:
        """Name of the frame of the chain's base."""
        return self.settings.frame_prefix + self.settings.base_frame

    def with_settings(self, settings: ChainSettings) -> ChainFile:
        """The same chain with other settings."""
        chain = Chain(self.chain.links, self.chain.end, settings.slopes)
        before = len(self.settings.frame_prefix)
        prefixes = [settings.frame_prefix + rig.monitor.frame_prefix[before:] for rig in self.rigs]
        rigs = [replace_values(rig, {FRAME_PREFIX: new}) for rig, new in zip(self.rigs, prefixes, strict=True)]
        return replace(self, chain=chain, rigs=tuple(rigs), settings=settings)


def read_chain(path: str | Path, given: Mapping[str, object] | None = None, slopes: str | None = None) -> ChainFile:
    """The chain in the file ``path``. Raises ConfigError.

    ``given``: parameters that every rig has. ``slopes``: instead of that of the file.
    """
    path = Path(path)
    settings, tree = _read(SETTINGS, tree_of_file(path, 'chain file'), str(path), ('links', 'end_effector'))
    links = tree.get('links')
    if not isinstance(links, list) or not 1 <= len(links) <= MOST_LINKS:
        raise ConfigError(f'{path}: links: must be a list of 1 to {MOST_LINKS} links')
    read = [_link(path, number, entry, given or {}) for number, entry in enumerate(links, start=1)]
    end = _place(tree.get('end_effector', {}), f'{path}: end_effector')
    try:
        chain = Chain([link for link, _, _ in read], end, slopes or settings.slopes)
    except ConfigError as error:
        raise ConfigError(f'{path}: {error}') from None
    file = ChainFile(chain, tuple(rig for _, rig, _ in read), tuple(joint for _, _, joint in read))
    return file.with_settings(replace(settings, slopes=chain.slopes))


def _link(path: Path, number: int, entry: object, given: Mapping[str, object]) -> tuple[ChainLink, Rig, Joint]:
    read, more = _read(LINK, entry, f'{path}: link {number}', ('parameters', 'mount', 'joint'))
    where = f'{path}: {read.name}'
    rig = _rig(path, read, more.get('parameters', {}), given)
    joint, _ = _read(JOINT, more.get('joint', {}), f'{where}: joint')
    axis = np.array(joint.axis)
    link = ChainLink(
        read.name,
        _place(more.get('mount', {}), f'{where}: mount'),
        LinkStatics.from_rig(rig),
        rig.link.slope_ratio,
        read.slope_ratio_sd,
        axis / float(np.linalg.norm(axis)),
    )
    return link, rig, joint


def _rig(path: Path, link: _LinkEntry, parameters: object, given: Mapping[str, object]) -> Rig:
    where = f'{path}: {link.name}'
    flat: dict[str, object] = {FRAME_PREFIX: f'{link.name}_'}
    if link.rig:
        flat |= read_parameter_file(path.parent / link.rig)
    flat |= flattened(_map_of(parameters, f'{where}: parameters'), where)
    if link.port:
        flat['port'] = link.port
    rig = rig_from_values({**flat, **given}, where)
    # Recordings that begin in the same second must not be of one name.
    return replace_values(rig, {'bag_dir': str(Path(rig.acquisition.bag_dir) / link.name)}, where)


def _place(value: object, where: str) -> Transform:
    place, _ = _read(_PLACE, value, where)
    return of_position_and_angles(np.array(place.xyz), np.array(place.rpy))


def _read(section: Section[T], value: object, where: str, other_keys: tuple[str, ...] = ()) -> tuple[T, dict[str, Any]]:
    """What ``section`` declares, and the ``other_keys`` of a map."""
    known = tuple(p.name for p in section.parameters.values())
    tree = _map_of(value, where, (*known, *other_keys))
    # A key without a value is as good as none.
    values = {name: tree[name] for name in known if tree.get(name) is not None}
    return section.read(values, where), {name: tree[name] for name in other_keys if name in tree}


def _map_of(value: object, where: str, known: tuple[str, ...] = ()) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ConfigError(f'{where}: must be a map' + (f' with keys of {", ".join(known)}' if known else ''))
    for key in value if known else ():
        if key not in known:
            raise ConfigError(f'{where}: unknown key {key!r}{did_you_mean(str(key), known)}')
    return value
