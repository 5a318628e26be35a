# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Another vendor's DDS as judge: prints what it receives on one topic as JSON.

Run as ``python cyclone_subscriber.py TOPIC COUNT`` in ROS_DOMAIN_ID; a row is stamp in ns, frame,
position and orientation. The types are written from the ROS message definitions alone.
(No postponed annotations here: cyclonedds reads the types of the fields at run time.)
"""

import json
import os
import sys
from dataclasses import dataclass

from cyclonedds.core import Listener, Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import float64, int32, uint32
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration


@dataclass
class Time(IdlStruct, typename='builtin_interfaces::msg::dds_::Time_'):
    sec: int32
    nanosec: uint32


@dataclass
class Header(IdlStruct, typename='std_msgs::msg::dds_::Header_'):
    stamp: Time
    frame_id: str


@dataclass
class Point(IdlStruct, typename='geometry_msgs::msg::dds_::Point_'):
    x: float64
    y: float64
    z: float64


@dataclass
class Quaternion(IdlStruct, typename='geometry_msgs::msg::dds_::Quaternion_'):
    x: float64
    y: float64
    z: float64
    w: float64


@dataclass
class Pose(IdlStruct, typename='geometry_msgs::msg::dds_::Pose_'):
    position: Point
    orientation: Quaternion


@dataclass
class PoseStamped(IdlStruct, typename='geometry_msgs::msg::dds_::PoseStamped_'):
    header: Header
    pose: Pose


def main() -> int:
    name, count = sys.argv[1], int(sys.argv[2])
    participant = DomainParticipant(int(os.environ['ROS_DOMAIN_ID']))
    qos = Qos(Policy.Reliability.Reliable(duration(seconds=1)), Policy.History.KeepLast(100))
    reader = DataReader(participant, Topic(participant, name, PoseStamped), qos=qos, listener=Listener())
    rows: list[list[object]] = []
    for message in reader.take_iter(timeout=duration(seconds=60)):
        t, p, o = message.header.stamp, message.pose.position, message.pose.orientation
        rows.append([t.sec * 10**9 + t.nanosec, message.header.frame_id, p.x, p.y, p.z, o.x, o.y, o.z, o.w])
        if len(rows) == count:
            break
    json.dump(rows, sys.stdout)
    return 0 if len(rows) == count else 1


if __name__ == '__main__':
    sys.exit(main())
