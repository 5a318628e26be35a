# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What the page "Try it in the browser" computes: in the browser's own Python, by the functions of the package."""

from collections.abc import Callable

import numpy as np

import psd_deflection


def run(effect: str, seed: int, notify: Callable[[str, str], None]) -> None:
    """Simulate, estimate, discover. ``effect``: as ``simulate --effect`` takes it, or '' for none. ``notify`` gets what
    is done: 'step' and a sentence; 'answer' and each sentence of discover; 'report' and a web page."""
    notify('step', 'Simulating 24 s of the rig under known loads')
    recording = psd_deflection.simulate(loads='identification', effects=[effect] if effect else [], seed=seed)
    notify('step', f'Estimating from {len(recording.samples)} samples')
    estimates = psd_deflection.replay(recording)
    reach = np.ptp(estimates.dy) * 1e6
    notify('step', f'Searching: {len(estimates.t)} estimates, the tip has moved by {reach:.0f} µm')
    discovery = psd_deflection.discover([recording])
    for sentence in discovery.sentences():
        notify('answer', sentence)
    notify('step', 'Drawing the report')
    notify('report', discovery.report())
