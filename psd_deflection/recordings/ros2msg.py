"""The standard ROS 2 message definitions that we write, as text, since no ROS need be at hand.

A recording carries the definition of each of its types (MCAP schema encoding ``ros2msg``), and
the CDR encoder is made from the same text. Comments and constants that the standard files have
beyond these lines change neither bytes nor hashes; the tests hold fields and hashes against an
independent store of the standard definitions.
"""

from __future__ import annotations

from collections.abc import Mapping

_PARTS: Mapping[str, str] = {
    'builtin_interfaces/Time': 'int32 sec\nuint32 nanosec\n',
    'std_msgs/Header': 'builtin_interfaces/Time stamp\nstring frame_id\n',
    'geometry_msgs/Point': 'float64 x\nfloat64 y\nfloat64 z\n',
    'geometry_msgs/Vector3': 'float64 x\nfloat64 y\nfloat64 z\n',
    'geometry_msgs/Quaternion': 'float64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1\n',
    'geometry_msgs/Pose': 'geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n',
    'geometry_msgs/PoseWithCovariance': 'geometry_msgs/Pose pose\nfloat64[36] covariance\n',
    'geometry_msgs/Wrench': 'geometry_msgs/Vector3 force\ngeometry_msgs/Vector3 torque\n',
    'geometry_msgs/PointStamped': 'std_msgs/Header header\ngeometry_msgs/Point point\n',
    'geometry_msgs/PoseStamped': 'std_msgs/Header header\ngeometry_msgs/Pose pose\n',
    'geometry_msgs/PoseWithCovarianceStamped': 'std_msgs/Header header\ngeometry_msgs/PoseWithCovariance pose\n',
    'geometry_msgs/WrenchStamped': 'std_msgs/Header header\ngeometry_msgs/Wrench wrench\n',
    'sensor_msgs/PointField': (
        'uint8 INT8=1\nuint8 UINT8=2\nuint8 INT16=3\nuint8 UINT16=4\nuint8 INT32=5\nuint8 UINT32=6\n'
        'uint8 FLOAT32=7\nuint8 FLOAT64=8\nstring name\nuint32 offset\nuint8 datatype\nuint32 count\n'
    ),
    'sensor_msgs/PointCloud2': (
        'std_msgs/Header header\nuint32 height\nuint32 width\nsensor_msgs/PointField[] fields\n'
        'bool is_bigendian\nuint32 point_step\nuint32 row_step\nuint8[] data\nbool is_dense\n'
    ),
    'sensor_msgs/Temperature': 'std_msgs/Header header\nfloat64 temperature\nfloat64 variance\n',
    'diagnostic_msgs/KeyValue': 'string key\nstring value\n',
    'diagnostic_msgs/DiagnosticStatus': (
        'byte OK=0\nbyte WARN=1\nbyte ERROR=2\nbyte STALE=3\n'
        'byte level\nstring name\nstring message\nstring hardware_id\ndiagnostic_msgs/KeyValue[] values\n'
    ),
    'diagnostic_msgs/DiagnosticArray': ('std_msgs/Header header\ndiagnostic_msgs/DiagnosticStatus[] status\n'),
}

TYPE_HASHES: Mapping[str, str] = {
    'diagnostic_msgs/msg/DiagnosticArray': 'RIHS01_5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e',
    'geometry_msgs/msg/PointStamped': 'RIHS01_4c0296af86e01e562e9e0405d138a01537247580076c58ea38d7923ac1045897',
    'geometry_msgs/msg/PoseStamped': 'RIHS01_10f3786d7d40fd2b54367835614bff85d4ad3b5dab62bf8bca0cc232d73b4cd8',
    'geometry_msgs/msg/PoseWithCovarianceStamped': (
        'RIHS01_26432f9803e43727d3c8f668d1fdb3c630f548af631e2f4e31382371bfea3b6e'
    ),
    'geometry_msgs/msg/WrenchStamped': 'RIHS01_8dc3deaf06b2ab281f9f9a742a8961c328ca7cec16e3fd6586d3a5c83fa78f77',
    'sensor_msgs/msg/PointCloud2': 'RIHS01_9198cabf7da3796ae6fe19c4cb3bdd3525492988c70522628af5daa124bae2b5',
    'sensor_msgs/msg/Temperature': 'RIHS01_72514a14126ab9f8a9abec974c78e5610a367b59db5da355ff1fb982d5bad4b8',
}
"""REP-2011 type hashes of the types that have a topic; rosbag2 notes them beside each topic."""

_SEPARATOR = '=' * 80 + '\n'


def _short(type_name: str) -> str:
    return type_name.replace('/msg/', '/')


def members(type_name: str) -> list[tuple[str, str]]:
    """(type, name) of each field of ``pkg/Name`` or ``pkg/msg/Name``; none where it is no message of ours."""
    lines = _PARTS.get(_short(type_name), '').splitlines()
    return [(line.split()[0], line.split()[1]) for line in lines if '=' not in line]


def definition(type_name: str) -> str:
    """The definition of ``pkg/msg/Name`` followed by all that it is made of. Raises KeyError."""
    seen: list[str] = []

    def visit(short: str) -> None:
        if short in seen:
            return
        seen.append(short)
        for line in _PARTS[short].splitlines():
            inner = line.split()[0].partition('[')[0]
            if inner in _PARTS:
                visit(inner)

    visit(_short(type_name))
    first, *others = seen
    return _PARTS[first] + ''.join(f'{_SEPARATOR}MSG: {name}\n{_PARTS[name]}' for name in others)
