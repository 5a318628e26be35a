# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
export ROS_DISTRO=jazzy ROS_VERSION=2 ROS_PYTHON_VERSION=3 AMENT_PREFIX_PATH=/opt/ros/jazzy
export PATH=/opt/ros/jazzy/bin:$PATH PYTHONPATH=$(echo /opt/ros/jazzy/lib/python3.*/site-packages)
export LD_LIBRARY_PATH=/opt/ros/jazzy/lib:$(printf '%s:' /opt/ros/jazzy/lib/python3.*/site-packages/*.libs)
