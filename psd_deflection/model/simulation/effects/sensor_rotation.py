# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A PSD's axes are turned in its plane (E_Algn)."""

from psd_deflection.base.arithmetic import Arithmetic
from psd_deflection.model.detector.response import rotated
from psd_deflection.model.simulation.declaration import PSD, Effect, EffectParameter, Reading, State, Values
from psd_deflection.model.simulation.samples import SimulatedSamples
from psd_deflection.records import FloatArray


def _rotate(dots: FloatArray, psd: float, angle: float, xp: Arithmetic) -> None:
    i = 2 * (int(psd) - 1)
    dots[i], dots[i + 1] = rotated(dots[i], dots[i + 1], xp.cos(angle), xp.sin(angle))


def _apply(samples: SimulatedSamples, values: Values, state: State) -> None:
    _rotate(samples.dots, values['psd'], values['angle'], samples.physics.xp)


def _correct(reading: Reading, values: Values) -> None:
    _rotate(reading.dots, values['psd'], -values['angle'], reading.xp)


EFFECT = Effect(
    name='sensor_rotation',
    stage='psd',
    summary="a PSD's axes are turned in its plane",
    equation='m = Rz(-angle) m_true',
    source='thesis chapter 3: E_Algn',
    needs='dots that move',
    parameters=(PSD, EffectParameter('angle', 'rad', -3.2, 3.2, 1e-3, 'turn of the axes about +Z')),
    point='dots',
    apply=_apply,
    correct=_correct,
    order=2,
    calibrated_as={'angle': 'rotation'},
    also=('rotation',),
)
