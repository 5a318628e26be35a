# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The command line: ``psd-deflection COMMAND``; one file a command.

``run``: commands of a running rig. ``recordings``: of recordings. ``studies``: of a study.
"""
