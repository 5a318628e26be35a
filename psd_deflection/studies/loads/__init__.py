# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The loads of a recording as they acted, by the motion: when each began, what hung, what a load cell measured."""
