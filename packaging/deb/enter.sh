# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
# A shell in the chroot $1; its mounts end with it. In /tmp lie the locks by which the tests share the domains of ROS.
mount --rbind /dev "$1/dev" && mount -t proc proc "$1/proc" && mount --bind /tmp "$1/tmp" || exit 1
cp /etc/resolv.conf /etc/hosts "$1/etc"
mkdir -p "$1/etc/ssl" && cp /etc/ssl/certs/ca-certificates.crt "$1/etc/ssl/ours.crt"
exec env -i HOME=/root TERM=dumb LANG=C.UTF-8 DEBIAN_FRONTEND=noninteractive PIP_CERT=/etc/ssl/ours.crt \
    PATH=/usr/sbin:/usr/bin:/sbin:/bin chroot "$1" sh -ec "$2"
