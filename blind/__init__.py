# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The blind suite: truth from a second generator that shares no code with the simulation."""
