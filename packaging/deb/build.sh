# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
# The .deb of the templates of bloom, and a stand-in for the packages of ROS that it asks for.
apt-get install -qq --no-install-recommends dpkg-dev build-essential debhelper dh-python python3-all python3-setuptools equivs >/dev/null 2>&1
cd /root/deb && DEB_BUILD_OPTIONS=nocheck DEB_BUILD_PROFILES=nocheck dpkg-buildpackage -b -us -uc >../build.log 2>&1 \
    || { tail -n 20 ../build.log; exit 1; }
cd /root
names=$(dpkg-deb -f ros-jazzy-psd-deflection_*.deb Depends | tr , '\n' | grep -o 'ros-[a-z0-9-]*' | paste -sd,)
printf 'Package: stand-in-for-ros\nVersion: 1\nProvides: %s\nDescription: nothing\n' "$names" >control
equivs-build control >/dev/null 2>&1
