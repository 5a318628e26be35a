# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
# What the image of ROS has, and the versions of Ubuntu 24.04 over those of Debian.
apt-get update -qq
apt-get install -qq --no-install-recommends build-essential ca-certificates git libxml2-utils     python3-{argcomplete,dev,empy,importlib-metadata,lark,netifaces,osrf-pycommon,pip,psutil,rosdep2,venv}
python3 -m pip install --quiet --break-system-packages -c /opt/ubuntu-24.04.txt     numpy scipy pandas pyserial PyYAML ruamel.yaml tqdm zstandard aiohttp jsonschema==4.10.3 setuptools==68.1.2     hypothesis==6.98.15 pytest==7.4.4 pytest-xdist==3.4.0 pytest-timeout==2.2.0
