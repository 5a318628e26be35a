# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The node ``camera``: images (raw or compressed) in, ``/reference/deflection`` with covariance out, and why frames are
rejected. Of the frames that come while one is measured, all but the last are dropped."""

import collections
import contextlib
import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

from msg_adapters import REFERENCE, REFERENCE_WITH_COVARIANCE, to_messages
from psd_deflection.base.errors import ConfigError
from psd_deflection.base.log import WARNING, LogCallback
from psd_deflection.camera.answer import FrameAnswer, Status
from psd_deflection.camera.footage import decoded, of_ros_image
from psd_deflection.camera.opencv import opencv
from psd_deflection.camera.reference import CameraReference
from psd_deflection.camera.settings import SETTINGS, CameraSettings
from psd_deflection.camera.target import target_of
from psd_deflection.recordings import cdr
from psd_deflection.records import Record, ReferencePose
from psd_deflection.ros.declared import DeclaredParameters
from psd_deflection.ros.gate import stamp_fault
from psd_deflection.ros.node import BaseNode, Health, serve
from psd_deflection.ros.running import ros
from psd_deflection.ros.topics import CAMERA_INFO, COMPRESSED, IMAGE
from psd_deflection.run.diagnostics import ERROR, OK, STALE, WARN
from psd_deflection.run.realtime import SHARED_MEMORY, shared_memory_left

NODE_NAME = 'camera'
MOST_DISTORTIONS = 14
SHARED_BYTES = 1_000_000
"""Shared memory that Fast DDS takes for a participant and its ports."""
LARGEST_NUMBER = 1e7
"""Bound of the numbers of a camera's matrix, px, and of its distortion."""


class CameraNode(BaseNode[CameraSettings]):
    """The node. ``given``: parameters of a file or an option. Raises ConfigError if OpenCV is missing, too."""

    def __init__(self, given: CameraSettings, log: LogCallback) -> None:
        opencv()
        self._given = given
        self._reference: CameraReference | None = None
        self._info: Any = None
        self._since: collections.Counter[str] = collections.Counter()  # Bound: one second.
        self._last: FrameAnswer | None = None
        super().__init__(NODE_NAME, log)

    def declare(self) -> DeclaredParameters[CameraSettings]:
        """Those of a camera."""
        return self.declare_section(SETTINGS, self._given, self._changed)

    def set_up(self) -> None:
        """Listen to images."""
        target_of(self.settings)
        self._out = {topic: self.publisher(topic) for topic in (REFERENCE, REFERENCE_WITH_COVARIANCE)}
        image = self.node.resolve_topic_name(IMAGE)
        compressed = self._beside(COMPRESSED, f'{image}/compressed')
        # As image_transport has it: the camera's information is beside its images.
        info = self._beside(CAMERA_INFO, image.rpartition('/')[0] + '/camera_info')
        self.gate.listen(IMAGE, _image_fault, self._image, image)
        self.gate.listen(COMPRESSED, _image_fault, self._compressed, compressed)
        self.gate.listen(CAMERA_INFO, _info_fault, self._take_info, info)
        topics = ', '.join(publisher.topic_name for publisher in self._out.values())
        self.log(f'waiting for images on {image}; publishing {topics}')

    def _beside(self, topic: str, usual: str) -> str:
        """``topic`` if the user has remapped it, else the ``usual`` name beside the image."""
        reported: str = self.node.resolve_topic_name(topic)
        return usual if reported == self.node.resolve_topic_name(topic, only_expand=True) else reported

    def _changed(self, settings: CameraSettings) -> None:
        target_of(settings)
        if self._reference is not None and replace(settings, exposure=self.settings.exposure) != self.settings:
            self._reference = None
            self.log('a parameter was changed: the next good frames are the rest', WARNING)

    def cleanup(self) -> None:
        """Forget the rest."""
        super().cleanup()
        self._reference = None

    def _take_info(self, message: Any) -> None:
        self._info = message

    def _image(self, message: Any) -> None:
        image = of_ros_image(
            message.height,
            message.width,
            message.encoding,
            bool(message.is_bigendian),
            message.step,
            bytes(message.data),
        )
        self._take(message.header.stamp, image)

    def _compressed(self, message: Any) -> None:
        self._take(message.header.stamp, decoded(bytes(message.data), opencv()))

    def _take(self, stamp: Any, image: Any) -> None:
        if not self.active:
            return
        t_ns = stamp.sec * 1_000_000_000 + stamp.nanosec + round(self.settings.exposure * 0.5e9)
        if self._reference is None:
            self._reference = self._begin()
        for answer in self._reference.take(t_ns, image):
            self._publish(answer)

    def _begin(self) -> CameraReference:
        settings = self.settings
        if not settings.matrix and self._info is not None and self._info.k[0] > 0.0:
            k, d = tuple(map(float, self._info.k)), tuple(map(float, self._info.d))
            try:
                settings = replace(settings, matrix=k, distortion=d)
            except (ConfigError, ValueError) as error:
                self.log(f'camera_info is not used: {error}', WARNING)
        if not settings.matrix:
            why = 'camera.matrix is not given and there is no camera_info'
            self.log(f'{why}: distortion is not corrected', WARNING)
        return CameraReference(settings, target_of)

    def _publish(self, answer: FrameAnswer) -> None:
        self._since[answer.words] += 1
        record = answer.as_record()
        if record is not None:
            self._last = answer
            self._send(ReferencePose(record.t_ns, record.dx, record.dy, record.theta))
            self._send(record)

    def _send(self, record: Record) -> None:
        for message in to_messages(record, self.frame_prefix):
            self._out[message.topic].publish(cdr.encode(message.type, message.fields))

    def health(self) -> Iterable[Health]:
        """Frames and answers of the last second, and why the others were rejected."""
        since, self._since = self._since, collections.Counter()
        frames, good = sum(since.values()), since.pop(str(Status.OK), 0)
        values = [('frames/s', str(frames)), ('answers/s', str(good))]
        values += [(f'rejected: {reason}', str(count)) for reason, count in since.most_common()]
        if self._last is not None and self._last.covariance is not None:
            names = (('sd dx (m)', 0), ('sd dy (m)', 1), ('sd theta (rad)', 2))
            values += [(name, f'{math.sqrt(float(self._last.covariance[i, i])):.3g}') for name, i in names]
        if self._reference is not None and self._reference.rest is not None:
            values.append(('turn of the camera (rad)', f'{self._reference.rotation:.6f}'))
        worst = since.most_common(1)
        if not frames:
            waits = self._reference is not None and self._reference.rest is None
            level, text = (WARN, 'the rest is not known yet') if waits else (STALE, 'no images')
        elif worst:
            level, text = (WARN if good else ERROR), f'{frames - good} of {frames} frames rejected: {worst[0][0]}'
        else:
            level, text = OK, f'{good} answers/s'
        if not self.active:
            level, text = STALE, 'not active'
        yield Health('reference', level, text, tuple(values))


def _image_fault(message: Any) -> str:
    return stamp_fault(message.header.stamp.sec, message.header.stamp.nanosec)


def _info_fault(message: Any) -> str:
    if len(message.d) > MOST_DISTORTIONS:
        return f'{len(message.d)} numbers of distortion: must be at most {MOST_DISTORTIONS}'
    invalid = [number for number in (*message.k, *message.d) if not abs(number) <= LARGEST_NUMBER]
    return f'{invalid[0]:g}: must be finite and at most {LARGEST_NUMBER:g}' if invalid else ''


def run_camera(ros_arguments: Sequence[str], given: CameraSettings, log: LogCallback) -> int:
    """Measure until SIGINT or SIGTERM. Raises ConfigError."""
    free_bytes = shared_memory_left()
    if free_bytes < SHARED_BYTES:
        log(f'{SHARED_MEMORY} has {free_bytes // 1000} kB left, of {SHARED_BYTES // 1000}: images come by UDP', WARNING)
    with (
        ros(NODE_NAME, ros_arguments, shared_memory=free_bytes >= SHARED_BYTES) as signals,
        contextlib.closing(CameraNode(given, log)) as owner,
    ):
        serve(owner, signals)
    return 0
