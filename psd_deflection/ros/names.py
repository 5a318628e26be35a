"""Names of the node on the graph, and the QoS of each topic. It needs no rclpy, so any module may import it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from msg_adapters import INPUTS, LATCHED, LOAD, SAMPLES
from psd_deflection.records import MOST_PSDS


class Delivery(NamedTuple):
    """QoS of a topic: messages kept for a slow subscriber, and whether a late one gets the last message."""

    depth: int
    reliable: bool = True
    latched: bool = False


TF, TF_STATIC = '/tf', '/tf_static'
VOLTS = tuple(f'/psd_{n}/volts' for n in range(1, MOST_PSDS + 1))
MARKERS = '/link_tip/markers'
MARKERS_AT_REST = '/link_tip/markers_at_rest'
_LATCHED = Delivery(depth=1, latched=True)

_SAMPLES_DEPTH = 50
"""A second of raw blocks: a subscriber that pauses for less misses none."""

_DELIVERY: Mapping[str, Delivery] = {
    SAMPLES: Delivery(_SAMPLES_DEPTH),
    # A block's samples come at once.
    **dict.fromkeys(VOLTS, Delivery(20 * _SAMPLES_DEPTH)),
    TF: Delivery(100),
    TF_STATIC: _LATCHED,
    MARKERS_AT_REST: _LATCHED,
    **dict.fromkeys(LATCHED, _LATCHED),
    **{topic: Delivery(_SAMPLES_DEPTH, reliable=False) for topic in INPUTS},
    # It holds until the next: a lost message would be a wrong label of all that follows.
    LOAD: Delivery(_SAMPLES_DEPTH),
}


def delivery(topic: str) -> Delivery:
    """How ``topic`` is published, or subscribed to if it is an input."""
    return _DELIVERY.get(topic, Delivery(depth=10))


END, END_REST = 'end_effector', 'end_effector_rest'
"""Frames of a chain of links: the end effector, and where it were if no link bent."""

JOINT_STATES = 'joint_states'

ZERO, RECORD = '~/zero', '~/record'
SERVICES = (ZERO, RECORD)
"""Services of the node; ``~`` stands for the node's name."""

BASE, REST, TIP = 'link_base', 'link_tip_rest', 'link_tip'
PSDS = tuple(f'psd_{n}' for n in range(1, MOST_PSDS + 1))
"""Frames: the clamp, the unloaded tip, the tip, the PSDs that a rig may have."""
