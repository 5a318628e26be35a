# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""How a real rig differs from its rig file, as one vector of parameters, and what that does to readings and poses.

``model``: parameters and pose -> readings. ``rig``: the vector of a rig file, and its uncertainty. ``spread``: what
the uncertainty adds to the covariance of an estimate.
"""
