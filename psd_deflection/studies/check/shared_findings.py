# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What check and discover both judge, once: noise, and what was noted of the loads, against file and recording."""

import math
from collections.abc import Mapping, Sequence

import numpy as np

from psd_deflection.records import FloatArray, channel_names, dot_names
from psd_deflection.rig.config import Rig
from psd_deflection.rig.declarations import LEAST_BITS
from psd_deflection.rig.wiring import Wiring
from psd_deflection.studies.check.result import Finding
from psd_deflection.studies.check.wirings import differences, fix_of, line, parameters
from psd_deflection.studies.loads.effective import LoadNote

NOISE_FACTOR = 2.0
"""Report noise that differs from the rig file's by more than this factor.

The noise of a healthy rig changes by half with light and temperature, and the noise between neighbouring samples, which
check measures, is down to 0.6 of the whole if it has a memory. Neither is a mistake.
"""
FORCE_UNITS = {9.80665: 'kg', 9.80665e-3: 'g', 4.4482216: 'lbf', 1e3: 'kN', 1e-3: 'mN', 0.2780139: 'ozf'}
TORQUE_UNITS = {9.80665: 'kg m', 0.0980665: 'kg cm', 9.80665e-3: 'kg mm', 1e3: 'kN m', 1e-3: 'N mm', 1e-2: 'N cm'}
"""Newtons and newton metres of each unit."""
OF_POUNDS = {1.3558179: 'lbf ft', 0.1129848: 'lbf in'}
"""Of a torque beside forces in pounds; by itself a torque that is off by a third is a stiffness."""
UNIT_TOLERANCE = 0.03
"""Share by which the size of a load may differ from another unit's. The rest is stiffness: a modulus that is wrong by a
digit makes forces ten times too large, which is 2 % from kilograms.
"""
LOADS = ('load_fx', 'load_fy', 'load_tz')


def noise_findings(
    rig: Rig, noise: FloatArray, steps: FloatArray | None = None
) -> tuple[list[Finding], dict[str, object]]:
    """Whether ``noise`` (P, 2), V rms a sample of x and y of each PSD, is the rig file's; lines that put it right.

    NaN for a channel that is stuck. A rig file that says the noise of each channel is held against each. ``steps``
    (P, 2), V: of the converter, where they are coarser than the rig file's: they make noise of their own.
    """
    dots = np.asarray(noise, dtype=np.float64).reshape(-1, 2)
    step = np.maximum(0.0 if steps is None else steps, rig.converter.volts_per_count)
    stated = np.hypot(rig.noises[:, :2], step / math.sqrt(12.0))
    if any(any(psd.noise) for psd in rig.psds):
        return _of_each_channel(dots, stated)
    there = np.isfinite(dots)
    if not there.any():
        return [], {}
    factor = math.sqrt(float(np.mean(dots[there] ** 2)) / float(np.mean(stated[there] ** 2)))
    if not _far(factor):
        return [], {}
    level = float(f'{factor * rig.amplifier.noise:.2g}')
    fix = line('amplifier.noise', level)
    finding = Finding('noise_level', ' '.join(dot_names(len(rig.psds))), round(factor, 3), fix, abs(math.log(factor)))
    return [finding], {'amplifier.noise': level}


def step_findings(rig: Rig, steps: FloatArray, *, finer: bool = False) -> tuple[list[Finding], dict[str, object]]:
    """Channels whose converter steps more coarsely than the rig file says; lines that put it right.

    ``steps`` (3P,), V, of the device's channels, 0 where they are the rig file's. ``finer``: some channels are seen to
    have these.
    """
    if not steps.any():
        return [], {}
    step_of_file = rig.converter.volts_per_count
    bits = rig.converter.bits - round(math.log2(float(steps.max()) / step_of_file))
    # There is one number of bits for all channels.
    coarse_enough = not finer and LEAST_BITS <= bits < rig.converter.bits
    right: dict[str, object] = {'converter.bits': bits} if coarse_enough else {}
    findings = []
    for name, step in zip(channel_names(len(steps) // 3), steps.tolist(), strict=True):
        if step:
            words = f'{name} steps by {step * 1e3:.3g} mV, the rig file says {step_of_file * 1e3:.3g} mV'
            fix = f'{line("converter.bits", bits)} ({words})' if right else words
            findings.append(Finding('converter_step', name, step, fix, math.log(step / step_of_file)))
    return findings, right


def _of_each_channel(noise: FloatArray, stated: FloatArray) -> tuple[list[Finding], dict[str, object]]:
    findings, lines = [], dict[str, object]()
    for psd in range(1, len(noise) + 1):
        noise_of_psd = noise[psd - 1]
        factors = noise_of_psd / stated[psd - 1]
        if not np.isfinite(noise_of_psd).all() or not any(map(_far, factors.tolist())):
            continue
        worst = int(np.argmax(np.abs(np.log(factors))))
        name, level = f'psd_{psd}.noise', [float(f'{v:.2g}') for v in noise_of_psd.tolist()]
        lines[name] = level
        factor = float(factors[worst])
        finding = Finding(
            'noise_level', f'{"xy"[worst]}{psd}', round(factor, 3), line(name, level), abs(math.log(factor))
        )
        findings.append(finding)
    return findings, lines


def _far(factor: float) -> bool:
    return factor > 0.0 and not 1.0 / NOISE_FACTOR <= factor <= NOISE_FACTOR


def note_finding(note: LoadNote, name: str) -> Finding:
    """A load that was noted at another time or as another one than it hung, swayed, or was not noted, of the recording
    ``name``.
    """
    return Finding(note.name, note.where, note.value, note.words(name), note.size)


def unit_findings(sizes: FloatArray, evidence: float = 0.0) -> tuple[list[Finding], FloatArray]:
    """Loads that are noted in another unit; by what each of the annotated loads (3,) is to be multiplied.

    ``sizes`` (3,): of the movement under each load over that of the annotated load, NaN where nothing tells.
    """
    factors = np.ones(3)
    units = _units(np.abs(sizes))
    findings = []
    for factor, unit in dict.fromkeys(units.values()):
        which = [k for k in units if units[k] == (factor, unit)]
        factors[which] = factor
        names = ' '.join(LOADS[k] for k in which)
        words = f'multiply {names} in the recording by {factor:g}: it is noted in {unit}'
        findings.append(Finding('load_unit', ' '.join(LOADS[k][5:] for k in which), factor, words, evidence))
    return findings, factors


def _units(sizes: FloatArray) -> dict[int, tuple[float, str]]:
    """Of each load that is noted in another unit the factor to multiply it with, and the unit."""
    out: dict[int, tuple[float, str]] = {}
    force = [float(s) for s in sizes[:2] if math.isfinite(s)]
    torque = float(sizes[2])
    if force and not _power_of_ten(force, torque) and (unit := _nearest(force, FORCE_UNITS, 'N')):
        out.update({k: unit for k in range(2) if math.isfinite(sizes[k])})
    beside = next((factor for factor, _ in out.values()), 0.0)
    if math.isfinite(torque) and (unit := _of_torque(torque, beside)):
        out[2] = unit
    return out


def _of_torque(size: float, force: float) -> tuple[float, str] | None:
    """The factor and unit of a torque; one with the unit of the forces, whose factor is ``force``, if that fits."""
    if not force:
        return _nearest([size], TORQUE_UNITS, 'N m')
    pounds = OF_POUNDS if _is('lbf', force) else {}
    alike = {f: unit for f, unit in TORQUE_UNITS.items() if _full_decades(f / force) or _full_decades(f * force)}
    return _nearest([size], {**alike, **pounds}, 'N m') or _nearest([size], TORQUE_UNITS, 'N m')


def _is(unit: str, factor: float) -> bool:
    return any(name == unit and factor in (f, 1.0 / f) for f, name in FORCE_UNITS.items())


def _full_decades(ratio: float) -> bool:
    return abs(math.log10(ratio) - round(math.log10(ratio))) < 1e-3


def _nearest(sizes: Sequence[float], units: Mapping[float, str], stated_unit: str) -> tuple[float, str] | None:
    """The factor and unit within ``UNIT_TOLERANCE`` of all ``sizes`` that is nearest: kg mm and N cm are 2 % apart."""
    fitting = [u for u in both_ways(units, stated_unit) if all(abs(s / u[0] - 1.0) < UNIT_TOLERANCE for s in sizes)]
    return min(fitting, key=lambda u: sum(abs(math.log(s / u[0])) for s in sizes), default=None)


def both_ways(units: Mapping[float, str], stated_unit: str) -> list[tuple[float, str]]:
    """Return each unit in place of ``stated_unit``, and this converted once more, with the factor that corrects it."""
    return [(f, f'{unit} instead of {stated_unit}') for f, unit in units.items()] + [
        (1.0 / f, f'{stated_unit}, and then converted from {unit} once more')
        for f, unit in units.items()
        if f not in (1e3, 1e-3)
    ]


def _power_of_ten(force: Sequence[float], torque: float) -> bool:
    """Return whether only the forces are off, and by ten: a digit of Young's modulus, not a unit."""
    return abs(torque - 1.0) < 0.1 and all(min(abs(10.0 * s - 1.0), abs(0.1 * s - 1.0)) < 0.01 for s in force)


def wiring_findings(
    wiring: Wiring, file: Wiring, evidence: float, equivalent: tuple[str, ...] = ()
) -> tuple[list[Finding], dict[str, object]]:
    """How ``wiring``, which is the right one, differs from that of the rig file; lines that put it right."""
    lines = parameters(wiring, file)
    findings = [
        Finding(
            name=d.name,
            where=d.where,
            value=-1.0 if d.name == 'channel_sign' else None,
            fix=fix_of(d, wiring, lines),
            evidence=evidence,
            equivalent=equivalent,
        )
        for d in differences(wiring, file)
    ]
    return findings, lines
