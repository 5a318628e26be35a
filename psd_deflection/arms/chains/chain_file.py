"""The file of a chain: its links with their rig files, ports, mounts and joints.

::

    slopes: end_force                # or ratio (the default)
    base_frame: base_link
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

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from psd_deflection.arms.chains.chain import Chain, ChainLink
from psd_deflection.arms.chains.transform import Transform, of_position_and_angles
from psd_deflection.base.errors import ConfigError, did_you_mean
from psd_deflection.base.foreign_yaml import tree_of_file
from psd_deflection.model.link.statics import LinkStatics
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import Rig, replace_values, rig_from_values
from psd_deflection.rig.declarations import FRAME_PREFIX
from psd_deflection.rig.parameter_files import flattened, read_parameter_file

MOST_LINKS = 32
BASE_FRAME = 'base_link'
LARGEST = 1000.0
"""Largest length, m, and angle, rad."""

_NAME = re.compile(r'[a-z][a-z0-9_]{0,39}')
_TOP = ('links', 'end_effector', 'slopes', 'base_frame')
_OF_LINK = ('name', 'rig', 'port', 'parameters', 'mount', 'joint', 'slope_ratio_sd')
_OF_PLACE = ('xyz', 'rpy')
_OF_JOINT = ('name', 'axis', 'angle')


@dataclass(frozen=True, slots=True)
class Joint:
    """The joint before a link: its ``name`` in joint states, '' if none tells it; ``angle``, rad, until one does."""

    name: str = ''
    angle: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class ChainFile:
    """``rigs`` and ``joints`` in the order of the links of ``chain``; ``base_frame``: name of the chain's base."""

    chain: Chain
    rigs: tuple[Rig, ...]
    joints: tuple[Joint, ...]
    base_frame: str = BASE_FRAME

    @property
    def names(self) -> tuple[str, ...]:
        """Of the links."""
        return tuple(link.name for link in self.chain.links)

    @property
    def angles(self) -> tuple[float, ...]:
        """Of the joints, as the file has them, rad."""
        return tuple(joint.angle for joint in self.joints)


def read_chain(path: str | Path, given: Mapping[str, object] | None = None, slopes: str | None = None) -> ChainFile:
    """The chain in the file ``path``. Raises ConfigError.

    ``given``: parameters that every rig has. ``slopes``: instead of that of the file.
    """
    path = Path(path)
    tree = _map_of(tree_of_file(path, 'chain file'), str(path), _TOP)
    links = tree.get('links')
    if not isinstance(links, list) or not 1 <= len(links) <= MOST_LINKS:
        raise ConfigError(f'{path}: links: must be a list of 1 to {MOST_LINKS} links')
    read = [_link(path, number, entry, given or {}) for number, entry in enumerate(links, start=1)]
    frame = tree.get('base_frame', BASE_FRAME)
    if not isinstance(frame, str) or not re.fullmatch(r'\w[\w/]{0,99}', frame):
        raise ConfigError(f'{path}: base_frame = {frame!r}: must be the name of a frame')
    end = _place(tree.get('end_effector', {}), f'{path}: end_effector')
    try:
        chain = Chain([link for link, _, _ in read], end, slopes or tree.get('slopes', 'ratio'))
    except ConfigError as error:
        raise ConfigError(f'{path}: {error}') from None
    return ChainFile(chain, tuple(rig for _, rig, _ in read), tuple(joint for _, _, joint in read), frame)


def _link(path: Path, number: int, entry: object, given: Mapping[str, object]) -> tuple[ChainLink, Rig, Joint]:
    where = f'{path}: link {number}'
    values = _map_of(entry, where, _OF_LINK)
    name = values.get('name')
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        raise ConfigError(f'{where}: name = {name!r}: must be a lower-case letter, then letters, digits and _')
    where = f'{path}: {name}'
    rig = _rig(path, where, values, name, given)
    joint = _map_of(values.get('joint', {}), f'{where}: joint', _OF_JOINT)
    axis = _three(joint.get('axis', (0.0, 0.0, 1.0)), f'{where}: joint.axis')
    length = float(np.linalg.norm(axis))
    if not length:
        raise ConfigError(f'{where}: joint.axis: must not be zero')
    joint_name = joint.get('name', '')
    if not isinstance(joint_name, str):
        raise ConfigError(f'{where}: joint.name = {joint_name!r}: must be a text')
    link = ChainLink(
        name,
        _place(values.get('mount', {}), f'{where}: mount'),
        LinkStatics.from_rig(rig),
        rig.link.slope_ratio,
        _number(values.get('slope_ratio_sd', 0.0), f'{where}: slope_ratio_sd', least=0.0),
        axis / length,
    )
    return link, rig, Joint(joint_name, _number(joint.get('angle', 0.0), f'{where}: joint.angle'))


def _rig(path: Path, where: str, values: Mapping[str, Any], name: str, given: Mapping[str, object]) -> Rig:
    flat: dict[str, object] = {FRAME_PREFIX: f'{name}_'}
    rig_file = values.get('rig')
    if rig_file is not None:
        if not isinstance(rig_file, str):
            raise ConfigError(f'{where}: rig = {rig_file!r}: must be the name of a rig file')
        flat |= read_parameter_file(path.parent / rig_file)
    flat |= flattened(_map_of(values.get('parameters', {}), f'{where}: parameters'), where)
    if values.get('port') is not None:
        flat['port'] = values['port']
    rig = rig_from_values({**flat, **given}, where)
    # Recordings that begin in the same second must not be of one name.
    return replace_values(rig, {'bag_dir': str(Path(rig.acquisition.bag_dir) / name)}, where)


def _place(value: object, where: str) -> Transform:
    place = _map_of(value, where, _OF_PLACE)
    zero = (0.0, 0.0, 0.0)
    return of_position_and_angles(
        _three(place.get('xyz', zero), f'{where}.xyz'), _three(place.get('rpy', zero), f'{where}.rpy')
    )


def _map_of(value: object, where: str, known: tuple[str, ...] = ()) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ConfigError(f'{where}: must be a map' + (f' with keys of {", ".join(known)}' if known else ''))
    for key in value if known else ():
        if known and key not in known:
            raise ConfigError(f'{where}: unknown key {key!r}{did_you_mean(str(key), known)}')
    return value


def _three(value: object, where: str) -> FloatArray:
    if not isinstance(value, list | tuple) or len(value) != 3:
        raise ConfigError(f'{where}: must be a list of three numbers')
    return np.array([_number(number, where) for number in value])


def _number(value: object, where: str, least: float = -LARGEST) -> float:
    number = float(value) if isinstance(value, int | float) and not isinstance(value, bool) else math.nan
    if not least <= number <= LARGEST:
        raise ConfigError(f'{where} = {value!r}: must be a number of {least:g} to {LARGEST:g}')
    return number
