# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The live page: shows the rig in a browser and loads nothing from outside hosts.

``feed`` takes records off the pipeline thread through a bounded queue, ``server`` serves the page and a
websocket in its own thread, ``access`` decides who may do what, ``shown`` is the source of the page: a
running session, or a recording in real time.
"""
