# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Draws a picture of docs/figures: ``python -m tools.figures NAME [FILE]``, NAME of FIGURES."""

import base64
import io
import json
import shlex
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Arc, Circle, FancyArrowPatch, Rectangle
from PIL import Image
from scipy.signal import savgol_filter
from selenium.webdriver.support.ui import WebDriverWait

from blind import motion
from blind.generator import MM_PER_V, RATE
from blind.watch import BLOCK, HELD_FROM_S, SIZES, Chain, happened
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.measure.uncertainty.block_fit import basis
from psd_deflection.records import TipMotion
from tools.browser import open_browser
from tools.program import PSD_DEFLECTION, ROOT, WAIT_S
from tools.shots import TWO_FRAMES, charted


def gain(orders: int, frequency: np.ndarray) -> np.ndarray:
    """Of a motion at ``frequency``, Hz: its part that the fit of so many orders gives at the block's middle."""
    q = basis(BLOCK)[:, :orders]
    s = np.arange(BLOCK) - 0.5 * (BLOCK - 1)
    # The middle's weights: even polynomials through the places, at 0.
    powers = np.stack([s**k for k in range(orders)], axis=1)
    weights = q @ (q.T @ powers) @ np.linalg.inv(powers.T @ powers)
    middle = weights[:, 0]
    return np.asarray(np.cos(2.0 * np.pi * np.outer(frequency, s) / RATE) @ middle)


def block_fit(target: str) -> None:
    """What a block gives of a motion."""
    frequency = np.linspace(0.0, 120.0, 600)
    figure, axes = plt.subplots(figsize=(7.0, 3.6), layout='constrained')
    for orders, label in ((1, 'mean'), (3, 'poly, orders 0 to 2'), (5, 'poly, orders 0 to 4')):
        axes.plot(frequency, gain(orders, frequency), label=label)
    for mode, name in ((14.0, 'bending'), (21.0, 'torsion')):
        axes.axvline(mode, color='0.7', linewidth=0.8)
        axes.annotate(f'{name}\n{mode:g} Hz', (mode, -0.22), fontsize=8)
        print(f'{mode:g} Hz: mean {gain(1, np.array([mode]))[0]:.4f}, poly {gain(5, np.array([mode]))[0]:.6f}')
    axes.set(xlabel='motion (Hz)', ylabel='estimate over motion', ylim=(-0.3, 1.2), xlim=(0.0, 120.0))
    axes.grid(alpha=0.3)
    axes.legend()
    figure.savefig(target, dpi=120)


_BLUE, _ORANGE, _GREEN, _RED, _GREY = '#1f6fb4', '#e07b1a', '#2f9455', '#c23b3b', '#777777'


def _arrow(ax: Any, start: tuple[float, float], end: tuple[float, float], color: str, **options: Any) -> None:
    ax.add_patch(FancyArrowPatch(start, end, arrowstyle='-|>', mutation_scale=12, color=color, **options))


def sign_convention(target: str) -> None:
    """Plate, PSDs and beams, and the positive direction of each quantity."""
    plt.rcParams.update({'figure.dpi': 110, 'font.size': 9})
    figure, (front, side, top) = plt.subplots(1, 3, figsize=(9.6, 4.2), width_ratios=(1.35, 1, 1), layout='constrained')
    for ax in (front, side, top):
        ax.set_aspect('equal')
        ax.axis('off')
    theta = np.radians(14.0)
    d = np.array([22.0, -16.0])
    turn = np.array([[np.cos(theta), -np.sin(theta)], [np.sin(theta), np.cos(theta)]])
    centers = np.array([[0.0, 70.0], [-100.0, 0.0]])
    front.add_patch(Circle((0, 0), 13, fill=False, color=_GREY, ls='--'))
    front.add_patch(Circle(tuple(d), 13, fill=False, color=_BLUE, lw=1.5))
    for i, c in enumerate(centers):
        front.add_patch(Rectangle(tuple(c - 15), 30, 30, fill=False, color=_GREY, ls='--'))
        moved = turn @ c + d
        corners = (turn @ np.array([[-15, 15, 15, -15, -15], [-15, -15, 15, 15, -15]])).T + moved
        front.plot(*corners.T, color=_BLUE, lw=1.5)
        front.plot(*zip(d, moved, strict=True), color=_BLUE, lw=0.8)
        front.plot(*c, 'o', color=_RED, ms=7)
        front.annotate(f'beam {i + 1}, PSD {i + 1}', c, (c[0] - 18, c[1] + 24), color=_RED)
    _arrow(front, (0, 0), (55, 0), 'black')
    _arrow(front, (0, 0), (0, 45), 'black')
    front.text(57, -3, 'X')
    front.text(-12, 40, 'Y')
    _arrow(front, (0, 0), (d[0], d[1]), _GREEN, lw=2)
    front.text(d[0] + 16, d[1] - 6, '(dX, dY)', color=_GREEN)
    front.add_patch(Arc(tuple(d), 70, 70, theta1=90, theta2=90 + np.degrees(theta), color=_ORANGE, lw=2))
    front.plot([d[0], d[0]], [d[1], d[1] + 44], color=_ORANGE, lw=0.8, ls=':')
    front.text(d[0] + 4, d[1] + 32, '+theta', color=_ORANGE)
    front.set(xlim=(-135, 85), ylim=(-72, 120))
    front.set_title(
        'from beyond the tip, looking at the base\n(Z towards you; from the lasers, +theta is clockwise)', fontsize=9
    )
    for ax, axis, angle, title in (
        (side, 'Y', 'phi', 'from the side: +phi leans\nthe tip towards -Y'),
        (top, 'X', 'omega', 'from above: +omega leans\nthe tip towards +X'),
    ):
        z = np.linspace(0, 100, 50)
        sag = (-1 if axis == 'Y' else 1) * 28 * (z / 100) ** 2 * (3 - z / 100) / 2
        ax.plot(z, 0 * z, color=_GREY, ls='--')
        ax.plot(z, sag, color=_BLUE, lw=2.5)
        slope = (sag[-1] - sag[-2]) / (z[-1] - z[-2])
        out = np.array([1.0, slope]) / np.hypot(1.0, slope)
        tip = np.array([100.0, sag[-1]])
        plate = np.outer([-1.0, 1.0], [-out[1], out[0]]) * 26 + tip
        ax.plot(*plate.T, color=_BLUE, lw=4)
        _arrow(ax, (100, 0), (130, 0), _GREY, ls='--')
        _arrow(ax, (tip[0], tip[1]), (tip[0] + 30 * out[0], tip[1] + 30 * out[1]), _ORANGE, lw=2)
        ax.text(tip[0] + 33, tip[1] + 26 * slope, f'+{angle}', color=_ORANGE)
        _arrow(ax, (100, 0), (100, sag[-1]), _GREEN, lw=2)
        ax.text(68, sag[-1] * 0.9 + 5, f'd{axis} {"<" if axis == "Y" else ">"} 0', color=_GREEN)
        _arrow(ax, (0, 0), (0, 32), 'black')
        ax.text(-3, 36, axis)
        ax.text(134, -3, 'Z')
        ax.plot([0, 112], [20 if axis == 'Y' else -22] * 2, color=_RED, lw=1)
        ax.text(4, 23 if axis == 'Y' else -19, 'beam', color=_RED)
        ax.set(xlim=(-12, 150), ylim=(-62, 62))
        ax.set_title(title, fontsize=9)
    # No date or version in the file: the same figure is the same bytes.
    figure.savefig(target, metadata={'Software': None})


STEP, DARK, END = 3.095, (3.4, 3.6), 3.8  # s: when the load is switched, when laser 2 is off, the end.


def switched(target: str) -> None:
    """A switched load and a lost laser."""
    loads = np.zeros((int(END * RATE), 3))
    loads[int(STEP * RATE) :, 0] = 10.0
    run = motion.run_of(loads, 1)
    dark = slice(*(int(t * RATE) for t in DARK))
    means = motion.pose_of(run.volts).reshape(-1, motion.BLOCK, 3).mean(axis=1)
    run.volts[dark, 3:] = 0.0
    pipeline = Pipeline(motion.rig_of())
    moved = [
        record
        for block in range(len(loads) // motion.BLOCK)
        for record in pipeline.process(motion.chunk(run, block))
        if isinstance(record, TipMotion)
    ]
    t = np.arange(len(loads)) / RATE
    at = np.array([m.t_ns for m in moved]) / 1e9
    middle = (np.arange(len(means)) + 0.5) * motion.BLOCK / RATE
    slope = savgol_filter(means[:, 0], 5, 3, deriv=1, delta=motion.BLOCK / RATE)
    figure, (above, below) = plt.subplots(2, 1, figsize=(8.0, 5.2), sharex=True, layout='constrained')
    rows = (
        (above, run.velocity[:, 0], [m.vx for m in moved], [m.velocity_covariance[0] for m in moved], 'mm/s'),
        (below, run.pose[:, 0], [m.dx for m in moved], [m.covariance[0] for m in moved], 'mm'),
    )
    for axes, truth, found, variance, label in rows:
        axes.plot(t, truth * 1e3, color='0.4', linewidth=1.0, label='truth')
        axes.errorbar(at, np.array(found) * 1e3, 3e3 * np.sqrt(variance), fmt='.', capsize=2, label='filter, ±3 sd')
        axes.axvspan(*DARK, color='0.92', label='laser 2 off')
        axes.set(ylabel=f'ΔX ({label})', xlim=(3.05, END))
        axes.grid(alpha=0.3)
    above.plot(middle, slope * 1e3, '--', color='tab:red', linewidth=0.9, label='Savitzky-Golay, block means')
    above.legend(ncols=2, fontsize=8)
    below.set(xlabel='time (s)')
    figure.savefig(target, dpi=120)


SEED = 4
CHANNELS = {'x1': 0, 'y1': 1, 'x2': 3, 'y2': 4}


def events(target: str) -> None:
    """Three events of the watch, and when they are seen."""
    figure = Figure(figsize=(10, 3.2), layout='constrained')
    axes = figure.subplots(1, len(SIZES))
    held = round(HELD_FROM_S * RATE)
    for axis, (kind, size) in zip(axes, SIZES.items(), strict=True):
        load, volts, event = happened(kind, SEED)
        chain = Chain()
        chain.load((0.0, 0.0, 0.0))
        chain.feed(volts[:held])
        chain.load(load)
        chain.feed(volts[held:])
        alarm = chain.raised[0]
        channel = alarm.channel if alarm.channel in CHANNELS else alarm.also[0]
        means = volts[: len(volts) // BLOCK * BLOCK, CHANNELS[channel]].reshape(-1, BLOCK).mean(axis=1) * MM_PER_V
        t = (np.arange(len(means)) + 0.5) * BLOCK / RATE
        before = (t > event - 5.0) & (t < event)
        shown = (t > event - 5.0) & (t < event + 8.0)
        axis.plot(t[shown] - event, 1e6 * (means[shown] - means[before].mean()), '.', ms=2, color='tab:blue')
        axis.axvline(alarm.since_ns / 1e9 - event, color='black', ls=':', label='since')
        axis.axvline(alarm.observed_ns / 1e9 - event, color='tab:red', label='alarm')
        axis.set_title(f'{kind} of {size}', fontsize=10)
        axis.set_xlabel('time since the event / s')
        axis.set_ylabel(f'{channel} / µm')
        axis.grid(alpha=0.25)
    axes[0].legend(frameon=False)
    figure.savefig(target, dpi=110)


def commands() -> list[str]:
    """The five commands of the section *Calibrate*."""
    text = (ROOT / 'docs' / 'calibration.md').read_text()
    section = text[text.index('\n## Calibrate\n') :]
    lines = [line for line in section.splitlines() if line.startswith('psd-deflection ')][:5]
    if [line.split()[1] for line in lines] != ['simulate', 'calibrate', 'simulate', 'validate', 'calibrate']:
        raise SystemExit(f'docs/calibration.md: other commands than expected: {lines}')
    return lines


def run(line: str, folder: Path) -> str:
    """What a command prints; SystemExit if it fails."""
    words = [*PSD_DEFLECTION, *shlex.split(line)[1:]]
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f'{line}\n{done.stdout}{done.stderr}')
    return done.stdout


def first_chart(page: Path) -> bytes:
    """A picture of the first chart of a report, as a browser shows it."""
    with tempfile.TemporaryDirectory() as profile:
        driver = open_browser(Path(profile), '--window-size=1030,900')
        try:
            driver.get(page.as_uri())
            driver.execute_script("document.documentElement.style.scrollbarWidth = 'none'")
            WebDriverWait(driver, WAIT_S).until(charted)
            driver.execute_async_script(TWO_FRAMES)
            box = driver.execute_script(
                'const b = document.querySelector("figure.chart").getBoundingClientRect();'
                'return {x: b.x + scrollX, y: b.y + scrollY, width: b.width, height: b.height, scale: 1}'
            )
            shot = driver.execute_cdp_cmd('Page.captureScreenshot', {'clip': box, 'captureBeyondViewport': True})
            return base64.b64decode(shot['data'])
        finally:
            driver.quit()


def save(content: bytes, target: Path) -> None:
    """Write a picture no wider than the page needs, in few colours."""
    image = Image.open(io.BytesIO(content)).convert('RGB')
    image.thumbnail((1000, 1000))
    image.quantize(48).save(target, optimize=True)


def groups(answer: str) -> bytes:
    """A bar for each group: how surely it did not move."""
    found = json.loads(answer)
    names = [g['name'] for g in found['groups']][::-1]
    figure = Figure(figsize=(8, 4.4), layout='constrained', dpi=90)
    FigureCanvasAgg(figure)
    axis = figure.subplots()
    axis.barh(names, [g['p'] for g in found['groups']][::-1], color='#4c72b0')
    axis.axvline(found['level'] / len(names), color='#c44e52', ls='--', label='below: it moved')
    axis.set_xscale('log')
    axis.set_xlabel(f'p of each group; all together {found["p"]:.2g}: {found["verdict"]}')
    axis.legend(frameon=False)
    stream = io.BytesIO()
    figure.savefig(stream, format='png')
    return stream.getvalue()


def calibration(target: str) -> None:
    """Run the five commands and draw; ``target``: a folder."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        shutil.copytree(ROOT / 'config', folder / 'config')
        lines = commands()
        for line in lines[:4]:
            run(line, folder)
        checked = run(f'{lines[4]} --json', folder)
        for recording, name in (('sidebar', 'calibrate_1.png'), ('link', 'calibrate_3.png')):
            run(f'psd-deflection plot {recording}.csv --out {recording}.png', folder)
            save((folder / f'{recording}.png').read_bytes(), Path(target) / name)
        save(first_chart(folder / 'calibrated' / 'report.html'), Path(target) / 'calibrate_2.png')
        save(first_chart(folder / 'validated' / 'report.html'), Path(target) / 'calibrate_4.png')
        save(groups(checked), Path(target) / 'calibrate_5.png')


FIGURES = {
    'block_fit': block_fit,
    'sign_convention': sign_convention,
    'motion': switched,
    'watch': events,
    'calibrate': calibration,
}


def main() -> int:
    """Draw it; calibrate_1 to calibrate_5 need Chromium."""
    name, *file = sys.argv[1:] or ['']
    if name not in FIGURES:
        print('NAME of', *FIGURES, file=sys.stderr)
        return 2
    folder = ROOT / 'docs' / 'figures'
    FIGURES[name](file[0] if file else str(folder if name == 'calibrate' else folder / f'{name}.png'))
    return 0


if __name__ == '__main__':
    sys.exit(main())
