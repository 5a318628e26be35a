# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Parameters that say how the node runs on one machine: its source and its recordings, and what viewers get.

They describe no rig; those that do, and the table of all, are in
:mod:`psd_deflection.rig.declarations`.
"""

from dataclasses import dataclass

from psd_deflection.rig.parameters import parameter


@dataclass(frozen=True, slots=True)
class AcquisitionConfig:
    """Where samples come from, how the node runs, and where samples are kept."""

    source: str = parameter(
        'serial',
        '',
        'what the device speaks: serial for our own frames; `psd-deflection devices --help` lists the others',
    )
    port: str = parameter(
        '',
        '',
        'serial port, socket://HOST:PORT (TCP), rfc2217://HOST:PORT or udp://HOST:PORT (two with a comma between, if '
        'the device has two), or recording; empty starts the simulated rig',
    )
    psds_exchanged: bool = parameter(False, '', "the device's x1 y1 sum1 come from PSD 2 and its x2 y2 sum2 from PSD 1")
    baud: int = parameter(
        921_600,
        'baud',
        'line speed (USB-CDC devices, socket:// and udp:// ignore it)',
        minimum=1200,
        maximum=12_000_000,
    )
    latency_offset: float = parameter(
        0.0, 's', 'constant delay of the link to take off every stamp', minimum=-1.0, maximum=1.0
    )
    queue_blocks: int = parameter(250, 'blocks', 'blocks that may wait for a slow consumer', minimum=2, maximum=100_000)
    serial_number: str = parameter(
        '',
        '',
        'serial number that the device must say (HELLO); with it the device is found again under another port name',
    )
    autostart: bool = parameter(True, '', 'configure and activate at start; false: wait for lifecycle transitions')
    demo: bool = parameter(
        False, '', 'without a port: weights hang on the simulated rig in turn; false: annotated loads are applied to it'
    )
    keep_zero: bool = parameter(True, '', '~/zero holds for later runs with the same device as well')
    zero_file: str = parameter(
        '', '', 'file in which the zero is kept; empty: by serial number below $XDG_STATE_HOME/psd_deflection'
    )
    realtime: bool = parameter(
        False, '', 'ask for SCHED_FIFO (reader) and locked memory; the log says what was granted'
    )
    thorlabs_x_sign: float = parameter(
        1.0,
        '',
        'sign of x of both aligners, 1 or -1: which it is shows when a dot is moved',
        name='thorlabs.x_sign',
        minimum=-1.0,
        maximum=1.0,
    )
    replay_stamps: str = parameter(
        'now',
        '',
        'times of replayed samples: of now in the recorded rhythm, or as recorded',
        name='replay.stamps',
        choices=('now', 'recorded'),
    )
    record: bool = parameter(False, '', 'record from the start')
    bag_dir: str = parameter('recordings', '', 'folder in which recordings are made')
    bag_max_bytes: int = parameter(
        0,
        'bytes',
        'a file of a recording that is as large is ended and the next begun; 0: never',
        minimum=0,
        maximum=1_000_000_000_000,
    )
    bag_max_duration: float = parameter(
        0.0,
        's',
        'a file of a recording that is as long is ended and the next begun; 0: never',
        minimum=0.0,
        maximum=1e7,
    )
    bag_keep: float = parameter(
        0.0,
        's',
        'files of a recording that ended longer ago are deleted (without bag_max_duration a file has a seventh of '
        'this); 0: never',
        minimum=0.0,
        maximum=1e9,
    )
    disk_reserve: int = parameter(
        500_000_000,
        'bytes',
        'recording stops before the disk has less room than this',
        minimum=1_000_000,
        maximum=1_000_000_000_000,
    )
    disk_full: str = parameter(
        'stop',
        '',
        "when the reserve is reached: stop, or delete the oldest file of this recording (never another's)",
        choices=('stop', 'delete_oldest'),
    )
    watch: str = parameter(
        'off',
        '',
        'test all the time whether the rig is still its model, and say in /diagnostics since when it is not (on)',
        choices=('off', 'on'),
        # YAML reads on and off as booleans.
        synonyms=((True, 'on'), (False, 'off')),
    )
    watch_wander: float = parameter(
        0.7e-6,
        'm',
        'by so much the readings of a sound rig may wander within a minute, without an alarm of the watch',
        minimum=0.0,
        maximum=1e-3,
    )
    watch_dir: str = parameter(
        '', '', 'folder in which the minutes around an alarm of the watch are kept as a recording; empty: none are kept'
    )
    watch_command: str = parameter(
        '',
        '',
        'program, with its arguments, that is run at each alarm of the watch, without a shell; it gets the alarm as '
        'JSON on its standard input; empty: none',
    )
    watch_webhook: str = parameter(
        '',
        '',
        'web address to which each alarm of the watch is posted as JSON, or the file that holds it (parameters are '
        'recorded: an address that is a secret belongs into a file); empty: none',
    )
    watch_minutes: float = parameter(
        5.0, 'min', 'how long before an alarm what is kept begins', minimum=0.5, maximum=60.0
    )
    watch_memory: int = parameter(
        100_000_000,
        'bytes',
        'memory for the minutes before an alarm; if it is full, the oldest half minute goes first',
        minimum=1_000_000,
        maximum=100_000_000_000,
    )
    watch_dir_max_bytes: int = parameter(
        2_000_000_000,
        'bytes',
        'of what the watch has kept in watch_dir the oldest is deleted if it is more than this',
        minimum=1_000_000,
        maximum=1_000_000_000_000,
    )
    watch_dir_max_recordings: int = parameter(
        100,
        '',
        'recordings of the watch in watch_dir; the oldest is deleted if there are more',
        minimum=1,
        maximum=100_000,
    )


@dataclass(frozen=True, slots=True)
class MonitorConfig:
    """What viewers get: frames, transforms, numbers to plot, markers in RViz and the live page."""

    frame_prefix: str = parameter(
        '', '', 'put before the name of every frame, in messages, recordings and transforms: left_ gives left_link_tip'
    )
    publish_tf: bool = parameter(
        True, '', 'publish the frames on /tf and /tf_static (needs tf2_msgs, which comes with a ROS installation)'
    )
    publish_volts: bool = parameter(
        False, '', 'publish each raw sample as plain numbers too, for plots (/psd_1/volts, /psd_2/volts ...)'
    )
    markers: bool = parameter(False, '', 'publish link, plate, beams and dots for RViz (/link_tip/markers)')
    markers_magnify: float = parameter(
        10.0, '', 'factor by which the markers exaggerate displacements', above=0.0, maximum=1e4
    )
    enabled: bool = parameter(False, '', 'serve the live page', name='monitor')
    address: str = parameter(
        '127.0.0.1', '', 'address it is served on; 0.0.0.0 shows it to the network', name='monitor_address'
    )
    port: int = parameter(
        8790, '', 'port it is served on; 0 takes any free one', name='monitor_port', minimum=0, maximum=65535
    )
    control: str = parameter(
        'local',
        '',
        'who may zero, record and note loads from the page: users of this machine if nobody else can reach it (local), '
        'also the network, with a token (on), nobody (off)',
        choices=('local', 'on', 'off'),
        # YAML reads on and off as booleans.
        synonyms=((True, 'on'), (False, 'off')),
        name='monitor_control',
    )
    history: bool = parameter(
        True,
        '',
        'the hours and days on the page hold for later runs with the same device as well',
        name='monitor_history',
    )
    foxglove: bool = parameter(False, '', 'serve the messages to Foxglove, without ROS')
    foxglove_address: str = parameter('127.0.0.1', '', 'address of that; 0.0.0.0 shows it to the network')
    foxglove_port: int = parameter(
        8765, '', 'port of that; 0, or one that is in use, takes any free one', minimum=0, maximum=65535
    )
    foxglove_origins: tuple[str, ...] = parameter(
        ('https://app.foxglove.dev', 'file://'),
        '',
        'pages from which a browser may connect to that: the web application, the desktop application (file://)',
    )
