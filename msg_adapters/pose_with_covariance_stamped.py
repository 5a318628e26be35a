"""geometry_msgs/PoseWithCovarianceStamped: the primary estimate with how sure it is."""

from __future__ import annotations

from msg_adapters.header import Fields, header
from msg_adapters.pose_stamped import FRAME, pose
from psd_deflection.records import DeflectionEstimate

TYPE = 'geometry_msgs/msg/PoseWithCovarianceStamped'

UNOBSERVED_VARIANCE = 1e6
"""On the diagonal of the axes that two flat PSDs do not see (z in m^2, roll and pitch in rad^2)."""

_OBSERVED = (0, 1, 5)
"""x, y and yaw in ROS order (x, y, z, roll, pitch, yaw)."""


def from_estimate(e: DeflectionEstimate) -> Fields:
    """Fields of the estimate: covariance 6 x 6, row by row, in ROS order."""
    covariance = [0.0] * 36
    for axis in (2, 3, 4):
        covariance[7 * axis] = UNOBSERVED_VARIANCE
    for i, row in enumerate(_OBSERVED):
        for j, column in enumerate(_OBSERVED):
            covariance[6 * row + column] = e.covariance[3 * i + j]
    return {
        'header': header(e.t_ns, FRAME),
        'pose': {'pose': pose(e.dx, e.dy, e.theta, e.phi, e.omega), 'covariance': covariance},
    }
