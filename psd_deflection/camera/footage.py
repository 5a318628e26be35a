# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Where a camera's frames come from: a folder of images, a video file, a device; and the camera's parameter file.

A folder has ``frames.csv`` with ``file,t,exposure`` (s; ``t`` is the start of the exposure). Of a video or a device the
exposure is not known: ``camera.exposure`` says it.
"""

import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from psd_deflection.base.csv_table import CsvTable, Row
from psd_deflection.base.errors import ConfigError, DeviceError, RecordingError
from psd_deflection.base.foreign_yaml import tree_of_text
from psd_deflection.camera.answer import NoPoseError
from psd_deflection.camera.opencv import MOST_BYTES, MOST_PIXELS, checked, opencv
from psd_deflection.camera.settings import CameraSettings, settings_from
from psd_deflection.rig.parameter_files import flattened, parameter_text

FRAMES = 'frames.csv'
_MOST_SECONDS = 9.2e9
_SILENT_READS = 50


class Frame(NamedTuple):
    """One frame: ``t_ns`` is the middle of its exposure; ``image`` grey, uint8 or uint16.

    If it cannot be read it is None, or the NoPoseError that says why.
    """

    name: str
    t_ns: int
    image: Any


def read_values(path: str | Path) -> dict[str, object]:
    """Return the values in ``CAMERA.yaml`` by their names: plain keys, dotted or nested, or a ROS 2 parameter file.

    Raises ConfigError.
    """
    path = Path(path)
    tree = tree_of_text(parameter_text(path), path)
    if not isinstance(tree, dict):
        raise ConfigError(f'{path}: has no parameters of a camera, as in "target.spacing: 0.025"')
    if 'camera_matrix' in tree:
        return _of_camera_info(tree, path)
    values: dict[str, object] = {}
    for name, body in tree.items():
        if isinstance(body, dict) and isinstance(body.get('ros__parameters'), dict):
            if name in {'/**', 'camera', '/camera', '/**/camera'}:
                values |= flattened(body['ros__parameters'], str(path))
        else:
            values |= flattened({name: body}, str(path))
    return values


def _of_camera_info(tree: Mapping[str, Any], path: Path) -> dict[str, object]:
    """Matrix and distortion of ROS's ``camera_info`` YAML, which may have our own keys beside its own."""
    values: dict[str, object] = {}
    for theirs, ours in (('camera_matrix', 'camera.matrix'), ('distortion_coefficients', 'camera.distortion')):
        body = tree.get(theirs)
        if not isinstance(body, dict) or 'data' not in body:
            raise ConfigError(f'{path}: {theirs}.data is missing: not a camera_info file')
        values[ours] = body['data']
    settings = {k: v for k, v in tree.items() if str(k).partition('.')[0] in {'target', 'camera', 'rest'}}
    return values | flattened(settings, str(path))


def read_settings(path: str | Path | None) -> CameraSettings:
    """Return the settings in ``CAMERA.yaml``; None: the defaults. Raises ConfigError."""
    return CameraSettings() if path is None else settings_from(read_values(path), str(path))


class Footage:
    """The frames of ``source`` in order: iterate. ``total``: how many, or None if that is not known.

    Raises RecordingError for a file or a folder that cannot be read, DeviceError for a device.
    """

    def __init__(self, source: str, exposure: float) -> None:
        self._exposure_ns = round(exposure * 1e9)
        path = Path(source)
        self.total: int | None = None
        self.live = False
        if path.is_dir():
            self._listed = _listed(path)
            self.total = len(self._listed)
            self._frames = self._of_folder()
        elif path.is_file():
            self._video = opencv().VideoCapture(str(path))
            if not self._video.isOpened():
                raise RecordingError(f'{path}: not a video that OpenCV can read; a single image goes into a folder')
            cv2 = opencv()
            columns, rows = (int(self._video.get(p)) for p in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
            if columns * rows > MOST_PIXELS:
                raise RecordingError(f'{path}: frames of {columns} x {rows} px: more than {MOST_PIXELS} pixels')
            count = int(self._video.get(cv2.CAP_PROP_FRAME_COUNT))
            self.total = count if count > 0 else None
            self._frames = self._of_video(path)
        elif path.exists() or source.isdecimal():
            self.live = True
            self._video = opencv().VideoCapture(int(source) if source.isdecimal() else source)
            if not self._video.isOpened():
                raise DeviceError(f'{source}: no camera that OpenCV can open; `v4l2-ctl --list-devices` lists them')
            self._frames = self._of_device(source)
        else:
            raise RecordingError(f'{source}: no such video, folder of images or device')

    def __iter__(self) -> Iterator[Frame]:
        return self._frames

    def _of_folder(self) -> Iterator[Frame]:
        cv2 = opencv()
        for path, t_ns, exposure_ns in self._listed:
            yield Frame(path.name, t_ns + exposure_ns // 2, decoded(_content(path) if path.is_file() else b'', cv2))

    def _of_video(self, path: Path) -> Iterator[Frame]:
        cv2 = opencv()
        number = 0
        while True:
            read, image = self._video.read()
            if not read:
                break
            t_ms = float(self._video.get(cv2.CAP_PROP_POS_MSEC))
            yield Frame(f'{path.name}:{number}', round(t_ms * 1e6) + self._exposure_ns // 2, grey(image))
            number += 1
        self._video.release()
        if number == 0:
            raise RecordingError(f'{path}: has no frame')

    def _of_device(self, source: str) -> Iterator[Frame]:
        number = silent = 0
        try:
            while silent < _SILENT_READS:
                read, image = self._video.read()
                # The driver's own stamps are not to be had; the frame was complete at this time at the latest.
                t_ns = time.time_ns() - self._exposure_ns // 2
                silent = 0 if read else silent + 1
                if read:
                    yield Frame(str(number), t_ns, grey(image))
                    number += 1
        finally:
            self._video.release()
        raise DeviceError(f'{source}: the camera gives no more frames; is it still connected?')


def _listed(folder: Path) -> list[tuple[Path, int, int]]:
    """File, start and length of the exposure (ns) of each frame of a folder. Raises RecordingError."""
    path = folder / FRAMES
    if not path.is_file():
        raise RecordingError(f'{folder}: has no {FRAMES}; write one with the columns file,t,exposure (s)')
    out: list[tuple[Path, int, int]] = []
    table = CsvTable(path)
    table.require(('file', 't', 'exposure'), 'a list of frames has file,t,exposure (s)')
    for row in table.table_rows():
        name = row.text('file')
        if not name or Path(name).name != name:
            raise row.reject(f'file {name!r}: must be the name of an image in {folder}')
        t, exposure = _seconds(row, 't'), _seconds(row, 'exposure')
        if exposure < 0 or (out and t <= out[-1][1]):
            raise row.reject('exposure is negative' if exposure < 0 else 't does not increase')
        out.append((folder / name, t, exposure))
    if not out:
        raise RecordingError(f'{path}: lists no frame')
    return out


def _seconds(row: Row, column: str) -> int:
    """Seconds as ns, exactly for as many decimals as there are. Raises RecordingError."""
    value = row.number(column, _MOST_SECONDS)
    seconds, point, part = row.text(column).partition('.')
    if point and seconds.lstrip('-').isdecimal() and part.isdecimal():
        sign = -1 if seconds.startswith('-') else 1
        return sign * (abs(int(seconds)) * 1_000_000_000 + int(part[:9].ljust(9, '0')))
    return round(value * 1e9)


def _content(path: Path) -> bytes:
    """Return the bytes of a file; one more than may be if there are more. Raises OSError."""
    with path.open('rb') as stream:
        return stream.read(MOST_BYTES + 1)


def read_image(path: str | Path) -> Any:
    """Return the image in a file, as of :func:`decoded`. Raises RecordingError if the file cannot be read."""
    try:
        content = _content(Path(path))
    except OSError as error:
        raise RecordingError(f'{path}: cannot be read ({error.strerror or error})') from None
    return decoded(content, opencv())


def decoded(content: bytes, cv2: Any) -> Any:
    """Return a grey image of the bytes of a file (PNG, JPEG …).

    None if they are none; the NoPoseError that says so if they declare an image that is too large: nothing is unpacked
    then.
    """
    if not len(content):
        return None
    try:
        checked(content)
        image = cv2.imdecode(np.frombuffer(content, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    except NoPoseError as error:
        return error.with_traceback(None)
    except cv2.error:
        return None
    return None if image is None else grey(image)


def grey(image: Any) -> Any:
    """Return an image as grey uint8 or uint16; None if it is of another kind."""
    cv2 = opencv()
    if image is None or image.dtype not in (np.uint8, np.uint16):
        return None
    if image.ndim == 2:
        return image
    conversion = {3: cv2.COLOR_BGR2GRAY, 4: cv2.COLOR_BGRA2GRAY}.get(image.shape[2])
    return None if conversion is None else cv2.cvtColor(image, conversion)


_ENCODINGS = {
    **dict.fromkeys(('mono8', '8UC1'), (np.uint8, 1, '')),
    **dict.fromkeys(('mono16', '16UC1'), (np.uint16, 1, '')),
    **dict.fromkeys(('bgr8', '8UC3'), (np.uint8, 3, 'COLOR_BGR2GRAY')),
    'rgb8': (np.uint8, 3, 'COLOR_RGB2GRAY'),
    'bgra8': (np.uint8, 4, 'COLOR_BGRA2GRAY'),
    'rgba8': (np.uint8, 4, 'COLOR_RGBA2GRAY'),
    # OpenCV names the pattern by its second row and column, ROS by its first.
    'bayer_rggb8': (np.uint8, 1, 'COLOR_BayerBG2GRAY'),
    'bayer_bggr8': (np.uint8, 1, 'COLOR_BayerRG2GRAY'),
    'bayer_gbrg8': (np.uint8, 1, 'COLOR_BayerGR2GRAY'),
    'bayer_grbg8': (np.uint8, 1, 'COLOR_BayerGB2GRAY'),
}


def of_ros_image(height: int, width: int, encoding: str, big_endian: bool, step: int, content: bytes) -> Any:
    """Return the grey image of a sensor_msgs/Image; None if it is of an encoding without brightness, or damaged."""
    entry = _ENCODINGS.get(encoding)
    if entry is None:
        return None
    kind, channels, conversion = entry
    wide = width * channels * np.dtype(kind).itemsize
    if not (
        0 < wide <= step
        and height > 0
        and step * height <= len(content) <= MOST_BYTES
        and height * width <= MOST_PIXELS
    ):
        return None
    rows = np.frombuffer(content, dtype=np.uint8, count=step * height).reshape(height, step)[:, :wide]
    image = np.ascontiguousarray(rows).view(np.dtype(kind).newbyteorder('>' if big_endian else '<')).astype(kind)
    image = image.reshape((height, width, channels) if channels > 1 else (height, width))
    cv2 = opencv()
    return cv2.cvtColor(image, getattr(cv2, conversion)) if conversion else image
