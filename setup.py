# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What ROS finds below share/ and lib/. Everything else is in setup.cfg."""

from glob import glob

from setuptools import setup

setup(
    # Not in setup.cfg: setuptools would make an object of it, which colcon cannot read back.
    python_requires='>=3.11',
    data_files=[
        ('share/ament_index/resource_index/packages', ['resource/psd_deflection']),
        ('share/psd_deflection', ['package.xml']),
        ('share/psd_deflection/config', glob('config/*')),
        ('share/psd_deflection/launch', glob('launch/*.launch.py')),
        # Of `ros2 run`. Not console scripts: pip would put names like `check` and `camera` on the path.
        ('lib/psd_deflection', glob('resource/ros2_run/*')),
    ],
)
