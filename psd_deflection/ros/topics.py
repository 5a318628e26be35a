# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Every topic of the nodes, a row each (:data:`PUBLISHED`, :data:`HEARD`, :data:`SERVED`), from which publishers,
subscriptions, actions and ``docs/topics.md`` are made; names of frames and services. It needs no rclpy."""

from collections.abc import Iterable, Mapping
from typing import NamedTuple

from msg_adapters import (
    BY_NAME,
    DEFLECTION_WITH_COVARIANCE,
    END_EFFECTOR,
    LATCHED,
    REFERENCE,
    REFERENCE_WITH_COVARIANCE,
    RELIABLE,
    SECOND_OF_BLOCKS,
    SOLVER,
    TOPICS,
    Delivery,
    Topic,
    solver_topic,
    vector3_stamped,
)
from psd_deflection.model.solvers.registry import SOLVERS
from psd_deflection.model.solvers.subset import NAME as ONE_PSD
from psd_deflection.records import MOST_PSDS

MOST_BYTES = 1_000_000
"""Maximum size of a message, unless the topic has its own; those of a robot's joints have some
hundred bytes."""
MOST_RECORDED_BYTES = 4096
"""Maximum size of a message of another node that is recorded, bytes; valid ones have some hundred
bytes."""
MOST_GOALS = 20
"""Goals of an action within a second: each is work of some milliseconds, and its result is kept for a
while."""
MOST_IMAGE_BYTES = 400_000_000
"""Maximum size of an image's message: that of the largest image that is read, with 16 bits a pixel.
"""
MOST_DESCRIPTION_BYTES = 20_000_000
"""Maximum size of a robot's description; the largest robots have some hundred thousand bytes."""
KEPT_LINES = 1000
"""Lines of the log that are kept for a late subscriber, as every node keeps them."""


class GraphTopic(NamedTuple):
    """A topic of a node, published or heard.

    ``name``: as of our own rig, ``/link_tip/deflection``; it becomes relative to the node's
    namespace, unless it is ``common`` to all nodes of a graph. ``type``: ``pkg/msg/Name``, or ''
    where a parameter names it. ``node``: the executable. ``description``: what is on it. ``overridable``:
    by ``qos_overrides`` parameters. ``most_bytes``: maximum size of a message that is heard.
    """

    name: str
    type: str
    node: str
    description: str
    delivery: Delivery = RELIABLE
    common: bool = False
    overridable: bool = True
    most_bytes: int = MOST_BYTES


class GraphAction(NamedTuple):
    """An action that a node serves.

    ``name``, ``node``, ``description``, ``most_bytes``: as of a topic. ``type``: ``pkg/action/Name``.
    """

    name: str
    type: str
    node: str
    description: str
    most_bytes: int = MOST_BYTES


TF, TF_STATIC, ROSOUT = '/tf', '/tf_static', '/rosout'
VOLTS = tuple(f'/psd_{n}/volts' for n in range(1, MOST_PSDS + 1))
MARKERS = '/link_tip/markers'
MARKERS_AT_REST = '/link_tip/markers_at_rest'
JOINT_STATES = 'joint_states'
ROBOT_DESCRIPTION = 'robot_description'
OFFSETS, COMMANDS, PROPOSED = '~/offsets', '~/commands', '~/proposed'
APPLIED, REFERENCE_COMMAND = '~/applied', '~/reference'
RUNNING, SCALING = '~/robot_running', '~/speed_scaling'
CONTROLLER = '~/controller_state'
TRAJECTORY, SHAPED = '~/trajectory', '~/shaped'
FOLLOW = '~/follow_joint_trajectory'
IMAGE, COMPRESSED, CAMERA_INFO = 'image', 'image/compressed', 'camera_info'

_ARRAY = 'std_msgs/msg/Float64MultiArray'
_MARKERS = 'visualization_msgs/msg/MarkerArray'
_TF_MESSAGE = 'tf2_msgs/msg/TFMessage'
_TRAJECTORY = 'trajectory_msgs/msg/JointTrajectory'
_POSE_WITH_COVARIANCE = BY_NAME[DEFLECTION_WITH_COVARIANCE].message.name

_ESTIMATOR, _CAMERA, _CHAIN, _COMPENSATOR, _SHAPER = 'estimator', 'camera', 'chain', 'compensator', 'shaper'
_EVERY = 'every node'


def _record_topic(topic: Topic, node: str = _ESTIMATOR) -> GraphTopic:
    """The row of a topic that carries a record; one that is common to all nodes is published by all."""
    return GraphTopic(
        topic.name,
        topic.message.name,
        _EVERY if topic.common else node,
        topic.description,
        topic.delivery,
        topic.common,
        most_bytes=MOST_RECORDED_BYTES,
    )


def _each_solver(row: GraphTopic) -> list[GraphTopic]:
    """``row``, or one row for each solver that can run."""
    if row.name != SOLVER:
        return [row]
    return [row._replace(name=solver_topic(solver)) for solver in dict.fromkeys((*SOLVERS, ONE_PSD))]


def _reference(topic: str) -> GraphTopic:
    # Reliable: a subscriber may ask for less, as the estimator does.
    return _record_topic(BY_NAME[topic], _CAMERA)._replace(delivery=RELIABLE)


_OUT = (
    *(row for t in TOPICS if t.to_record is None for row in _each_solver(_record_topic(t))),
    *(
        GraphTopic(
            name,
            vector3_stamped.MESSAGE.name,
            _ESTIMATOR,
            'with `publish_volts: true`: each raw sample as plain numbers (x, y, sum in V), for plots',
            # A block's samples come at once.
            Delivery(20 * SECOND_OF_BLOCKS),
        )
        for name in VOLTS
    ),
    GraphTopic(
        TF,
        _TF_MESSAGE,
        f'{_ESTIMATOR}, {_CHAIN}',
        '`link_base` → `link_tip_rest` → `link_tip` → `psd_1`, `psd_2`, true to scale; '
        'of a chain up to the end effector; where tf2_msgs is installed',
        Delivery(100),
        common=True,
    ),
    GraphTopic(
        TF_STATIC,
        _TF_MESSAGE,
        f'{_ESTIMATOR}, {_CHAIN}',
        'the frames that do not move; where tf2_msgs is installed',
        LATCHED,
        common=True,
    ),
    GraphTopic(
        MARKERS,
        _MARKERS,
        _ESTIMATOR,
        'with `markers: true`: bent link, plate, detectors and dots, ten times a second ([Viewers](monitor.md))',
    ),
    GraphTopic(
        MARKERS_AT_REST, _MARKERS, _ESTIMATOR, 'with `markers: true`: the unloaded link, lasers and beams', LATCHED
    ),
    _reference(REFERENCE),
    _reference(REFERENCE_WITH_COVARIANCE),
    GraphTopic(
        END_EFFECTOR,
        _POSE_WITH_COVARIANCE,
        _CHAIN,
        'the deflected pose in the frame `end_effector_rest`, the rigid pose; '
        'with all six axes observed ([Chains](chains.md))',
    ),
    GraphTopic(
        OFFSETS,
        _ARRAY,
        _COMPENSATOR,
        'offsets of the joints, rad or m, for a controller ([Compensation](compensation.md))',
        Delivery(5),
    ),
    GraphTopic(COMMANDS, _ARRAY, _COMPENSATOR, 'with `output: commands`: positions plus offsets', Delivery(5)),
    GraphTopic(PROPOSED, _ARRAY, _COMPENSATOR, 'when it runs dry: the offsets that it would send', Delivery(5)),
    GraphTopic(
        SHAPED,
        _TRAJECTORY,
        _SHAPER,
        'each trajectory, shaped so that it does not ring the link ([Shaping](shaping.md))',
    ),
    GraphTopic(
        ROSOUT,
        'rcl_interfaces/msg/Log',
        _EVERY,
        'the log, which a late subscriber gets, too',
        Delivery(KEPT_LINES, latched=True),
        common=True,
        # rcl publishes on it, too, before any parameter is read.
        overridable=False,
    ),
)

_INPUT = Delivery(5)
_NEWEST = Delivery(1, reliable=False)

_IN = (
    *(_record_topic(t) for t in TOPICS if t.to_record is not None),
    GraphTopic(IMAGE, 'sensor_msgs/msg/Image', _CAMERA, 'images of the target', _NEWEST, most_bytes=MOST_IMAGE_BYTES),
    GraphTopic(
        COMPRESSED,
        'sensor_msgs/msg/CompressedImage',
        _CAMERA,
        'compressed images of the target; it lies beside `image`',
        _NEWEST,
        most_bytes=MOST_IMAGE_BYTES,
    ),
    GraphTopic(
        CAMERA_INFO,
        'sensor_msgs/msg/CameraInfo',
        _CAMERA,
        'the lens, unless `camera.matrix` says it; it lies beside `image`',
        _NEWEST,
    ),
    GraphTopic(
        JOINT_STATES,
        'sensor_msgs/msg/JointState',
        f'{_CHAIN}, {_COMPENSATOR}, {_SHAPER}',
        'positions of the joints, rad or m',
        RELIABLE,
    ),
    GraphTopic(
        ROBOT_DESCRIPTION,
        'std_msgs/msg/String',
        f'{_COMPENSATOR}, {_SHAPER}',
        'the URDF of the robot, where no file is given',
        LATCHED,
        most_bytes=MOST_DESCRIPTION_BYTES,
    ),
    GraphTopic(
        END_EFFECTOR,
        _POSE_WITH_COVARIANCE,
        _COMPENSATOR,
        "the end effector's deflection, in `end_effector_rest`",
        _INPUT,
    ),
    GraphTopic(APPLIED, _ARRAY, _COMPENSATOR, 'the offsets that the controller applies, rad or m', _INPUT),
    GraphTopic(
        REFERENCE_COMMAND,
        'sensor_msgs/msg/JointState',
        _COMPENSATOR,
        'with `output: commands`: the command that the controller has, rad or m, by the names of the joints',
        _INPUT,
    ),
    # The first hears a driver that does not keep it, the second one that said it once, before we came.
    *(
        GraphTopic(
            RUNNING,
            'std_msgs/msg/Bool',
            _COMPENSATOR,
            'whether the robot runs its program, as ur_robot_driver says it; latched or not',
            delivery,
        )
        for delivery in (Delivery(1), LATCHED)
    ),
    GraphTopic(SCALING, 'std_msgs/msg/Float64', _COMPENSATOR, 'speed of the robot, a share or per cent', _INPUT),
    GraphTopic(
        CONTROLLER,
        '',
        _COMPENSATOR,
        'what the controller says while it is active, of the type that the parameter `controller_state` names',
        _INPUT,
    ),
    GraphTopic(TRAJECTORY, _TRAJECTORY, _SHAPER, 'trajectories of joints', RELIABLE),
)


def _by_name(rows: Iterable[GraphTopic]) -> dict[str, tuple[GraphTopic, ...]]:
    rows_by_name: dict[str, tuple[GraphTopic, ...]] = {}
    for row in rows:
        rows_by_name[row.name] = (*rows_by_name.get(row.name, ()), row)
    return rows_by_name


PUBLISHED: Mapping[str, GraphTopic] = {row.name: row for row in _OUT}
"""What the nodes publish, by name."""
HEARD: Mapping[str, tuple[GraphTopic, ...]] = _by_name(_IN)
"""What the nodes subscribe to, by name: a row for each subscription."""
SERVED: Mapping[str, GraphAction] = {
    FOLLOW: GraphAction(
        FOLLOW,
        'control_msgs/action/FollowJointTrajectory',
        _SHAPER,
        'with `action`: goals for the action of that name, shaped ([Shaping](shaping.md))',
    )
}
"""The actions that the nodes serve, by name."""


END, END_REST = 'end_effector', 'end_effector_rest'
"""Frames of a chain of links: the end effector, and where it were if no link bent."""

ZERO, RECORD = '~/zero', '~/record'
SERVICES = (ZERO, RECORD)
"""Services of the node; ``~`` stands for the node's name."""

BASE, REST, TIP = 'link_base', 'link_tip_rest', 'link_tip'
PSDS = tuple(f'psd_{n}' for n in range(1, MOST_PSDS + 1))
"""Frames: the clamp, the unloaded tip, the tip, the PSDs that a rig may have."""
