# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Another vendor's DDS sends goals that no client of ROS would send: text that is no text, or half a message.

Run as ``python cyclone_stranger.py TOPIC text|half`` in ROS_DOMAIN_ID; it sends until it is killed. The type is written
from the ROS definition alone: a string lies in a message as bytes do.
(No postponed annotations here: cyclonedds reads the types of the fields at run time.)
"""

import os
import signal
import sys
import threading
from dataclasses import dataclass

from cyclonedds.core import Listener, Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import array, int32, sequence, uint8, uint32
from cyclonedds.pub import DataWriter
from cyclonedds.topic import Topic
from cyclonedds.util import duration

PERIOD_S = 0.05
"""As many goals a second as are looked at: 20."""
NAME = 'control_msgs::action::dds_::FollowJointTrajectory_SendGoal_Request_'


@dataclass
class Goal(IdlStruct, typename=NAME):
    goal_id: array[uint8, 16]
    sec: int32
    nanosec: uint32
    frame_id: sequence[uint8]
    names_and_points: array[uint32, 4]
    other_frame_id: sequence[uint8]
    rest: array[uint32, 8]


@dataclass
class Half(IdlStruct, typename=NAME):
    goal_id: array[uint8, 16]
    sec: int32


def main() -> None:
    # Before DDS starts its threads, which would get it otherwise.
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGALRM})
    half = sys.argv[2] == 'half'
    participant = DomainParticipant(int(os.environ['ROS_DOMAIN_ID']))
    qos = Qos(
        Policy.Reliability.Reliable(duration(seconds=1)),
        Policy.History.KeepLast(10),
        Policy.DataRepresentation(use_cdrv0_representation=True),
    )
    heard = threading.Event()
    listener = Listener(on_publication_matched=lambda *_: heard.set())
    writer = DataWriter(participant, Topic(participant, sys.argv[1], Half if half else Goal), qos, listener=listener)
    # Before, nobody would get what it sends.
    heard.wait()
    signal.setitimer(signal.ITIMER_REAL, PERIOD_S, PERIOD_S)
    for number in range(10**6):
        goal_id = [*number.to_bytes(4, 'little'), *([0] * 12)]
        writer.write(Half(goal_id, 0) if half else Goal(goal_id, 0, 0, list(b'\xff\xfe\0'), [0] * 4, [0], [0] * 8))
        print('sent', number, flush=True)
        signal.sigwait({signal.SIGALRM})


if __name__ == '__main__':
    main()
