# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The ROS 2 node: the only subpackage that imports rclpy."""
