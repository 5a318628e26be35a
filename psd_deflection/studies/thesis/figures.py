# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The figures of docs/methods.md that the methods draw: ``thesis compare-methods --out DIR``."""

from collections.abc import Callable, Iterator
from typing import Any

import matplotlib as mpl

mpl.use('Agg')

import numpy as np
from matplotlib import pyplot as plt
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from psd_deflection.base.axes import MDEG
from psd_deflection.model.detector.sensors import Duolateral, Quadrant
from psd_deflection.model.plate import Geometry
from psd_deflection.model.plate.landing import landing
from psd_deflection.model.plate.linear import design_matrix, gain_matrix
from psd_deflection.model.plate.placement import pose_deviations
from psd_deflection.model.plate.plate import tied_pose
from psd_deflection.model.solvers.registry import make_solver
from psd_deflection.studies.thesis.comparison import (
    CONDITIONS,
    DIAMETERS,
    DIRECT,
    FORCES,
    SIDEBAR,
    VARIANCES,
    dots_of,
    errors,
    methods,
    spot_run,
    thesis_geometry,
)

_STYLE: Any = {
    'figure.dpi': 110,
    'font.size': 9,
    'axes.grid': True,
    'grid.alpha': 0.3,
    'axes.spines.top': False,
    'axes.spines.right': False,
    'legend.frameon': False,
    'svg.hashsalt': 'psd_deflection',
}
_BLUE, _ORANGE, _GREEN, _RED, _GREY = '#1f6fb4', '#e07b1a', '#2f9455', '#c23b3b', '#777777'


def drawn() -> Iterator[tuple[str, Figure]]:
    """Every figure and its name, one after the other; a figure is closed before the next is drawn."""
    with plt.rc_context(_STYLE):
        for name, draw in FIGURES.items():
            figure = draw()
            yield name, figure
            plt.close(figure)


def comparison() -> Figure:
    """Return the table of ``thesis compare-methods`` as a picture."""
    figure, axes = plt.subplots(1, 2, figsize=(9.6, 5.0), sharey=True, layout='constrained')
    shown = methods()[::-1]
    rows = np.arange(len(shown))
    for k, (condition, color) in enumerate(zip(CONDITIONS, (_BLUE, _ORANGE, _GREEN), strict=True)):
        cells = [errors(m, condition) for m in shown]
        translation = [1e6 * float(np.hypot(c.rms[0], c.rms[1])) for c in cells]
        twist = [MDEG * float(c.rms[2]) for c in cells]
        for ax, values in zip(axes, (translation, twist), strict=True):
            ax.plot(np.maximum(values, 1e-2), rows + 0.22 * (1 - k), 'o', color=color, ms=5, label=condition)
    for ax, label in zip(axes, ('tip deflection, rms µm', 'twist, rms mdeg'), strict=True):
        ax.set_xscale('log')
        ax.set(xlabel=label, xlim=(7e-3, 5e3), yticks=rows, yticklabels=[m.label for m in shown])
        ax.axvspan(7e-3, 1.4e-2, color=_GREY, alpha=0.15)
    axes[0].text(1.6e-2, 10.5, 'in the grey band: exact', color=_GREY, fontsize=8)
    axes[0].axvline(2.45, color='black', lw=0.8, ls=':')
    axes[1].axvline(1.328, color='black', lw=0.8, ls=':', label='noise, for 2 µm a reading')
    handles, labels = axes[1].get_legend_handles_labels()
    figure.legend(handles, labels, loc='outside lower center', ncols=4, fontsize=8)
    return figure


def iterative() -> Figure:
    """Return the PSDs' disagreement against the trial angle, and where each criterion stops."""
    geometry = thesis_geometry()
    pose = np.array([0.5e-3, -1.2e-3, np.radians(0.55), 0.0, 0.0])
    dots = dots_of(geometry, pose[None])[0]
    q = geometry.centers + dots.reshape(2, 2)
    angles = np.radians(np.linspace(0.0, 1.0, 401))
    c, s = np.cos(angles), np.sin(angles)
    gap_x = (geometry.beams[0, 0] - geometry.beams[1, 0]) - (c * (q[0, 0] - q[1, 0]) - s * (q[0, 1] - q[1, 1]))
    gap_y = (geometry.beams[0, 1] - geometry.beams[1, 1]) - (s * (q[0, 0] - q[1, 0]) + c * (q[0, 1] - q[1, 1]))
    figure, ax = plt.subplots(figsize=(6.4, 3.4), layout='constrained')
    degrees = np.degrees(angles)
    ax.plot(degrees, 1e3 * gap_x, color=_BLUE, label='ΔX of PSD 1 less PSD 2')
    ax.plot(degrees, 1e3 * gap_y, color=_ORANGE, label='ΔY of PSD 1 less PSD 2')
    ax.axhspan(-0.1, 0.1, color=_GREY, alpha=0.2, label='tolerance 0.1 mm')
    trial = tuple(dots.tolist()), tuple(VARIANCES.tolist())
    for criterion, name, color, height in (('absolute', 'first hit', _RED, -0.7), ('argmin', 'least', _GREEN, 0.62)):
        solution = make_solver('iterative_printed', geometry, criterion=criterion).solve(*trial)
        at = np.degrees(solution.theta)
        ax.axvline(at, color=color, lw=1.2)
        label = f'{name}: {at:.2f} deg, ΔX off {1e6 * (solution.dx - pose[0]):.0f} µm'
        ax.annotate(label, (at, height), (at - 0.02, height), ha='right', color=color, fontsize=8)
    ax.set(xlabel='trial angle, deg', ylabel='disagreement, mm', xlim=(0, 1))
    ax.legend(loc='upper right', fontsize=8)
    return figure


def linear() -> Figure:
    """Return the error of linearising, and which channels the weights use."""
    geometry = thesis_geometry()
    figure, (error_axes, leverage_axes) = plt.subplots(1, 2, figsize=(9.0, 3.4), layout='constrained')
    theta = np.radians(np.linspace(-3, 3, 121))
    poses = np.zeros((len(theta), 5))
    poses[:, 0], poses[:, 1], poses[:, 2] = 2e-3, -2e-3, theta
    dots = dots_of(geometry, poses)
    for label, name, options, color, dash in (
        ('ols', 'ols', {}, _BLUE, '-'),
        ('wls, thesis weights', 'wls', {'weights': 'thesis'}, _ORANGE, '-'),
        ('wls_exact (either weights)', 'wls_exact', {'weights': 'thesis'}, _GREEN, '-'),
    ):
        solution = make_solver(name, geometry, **options).solve_many(dots, VARIANCES).pose
        error_axes.plot(np.degrees(theta), 1e6 * (solution[:, 0] - 2e-3), color=color, ls=dash, label=label)
    error_axes.set(xlabel='twist, deg', ylabel='error of ΔX, µm', title='tip at (2, -2) mm, no noise')
    error_axes.legend(fontsize=8)
    design = design_matrix(geometry.beams)
    for k, (label, scaling, color) in enumerate(
        (
            ('equal', (1.0,) * 4, _BLUE),
            ('sidebar [0.03, 0.5, 10, 0.1]', SIDEBAR, _ORANGE),
            ('direct [3, 0.5, 10, 0.1]', DIRECT, _RED),
        )
    ):
        po = np.array(scaling)
        leverage = np.diag(po[:, None] * design @ gain_matrix(design, po) / po)
        leverage_axes.bar(np.arange(4) + 0.27 * (k - 1), leverage, 0.25, color=color, label=label)
    leverage_axes.set(xticks=range(4), xticklabels=['x1', 'y1', 'x2', 'y2'], ylabel='leverage', ylim=(0, 1.45))
    leverage_axes.set_title('how much of a reading its own fit follows')
    leverage_axes.legend(fontsize=8, loc='upper left')
    return figure


def exact() -> Figure:
    """Draws of the noise and the ellipse that the covariance claims."""
    geometry = thesis_geometry()
    pose = np.array([[1.5e-3, -2.5e-3, np.radians(-1.2), 0.0, 0.0]])
    rng = np.random.default_rng(1)
    dots = dots_of(geometry, pose) + 2e-6 * rng.standard_normal((3000, 4))
    solution = make_solver('exact', geometry).solve_many(dots, VARIANCES)
    off = (solution.pose - pose[0, :3]) * (1e6, 1e6, MDEG)
    claimed = solution.covariance[0] * np.outer((1e6, 1e6, MDEG), (1e6, 1e6, MDEG))
    figure, axes = plt.subplots(1, 2, figsize=(8.0, 3.6), layout='constrained')
    labels = ('error of ΔX, µm', 'error of ΔY, µm', 'error of θ, mdeg')
    for ax, (i, j) in zip(axes, ((0, 2), (1, 2)), strict=True):
        ax.plot(off[:, i], off[:, j], '.', ms=1.5, color=_BLUE)
        values, vectors = np.linalg.eigh(claimed[np.ix_([i, j], [i, j])])
        size = 2.0 * np.sqrt(5.9915 * values)
        tilt = np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1]))
        ax.add_patch(Ellipse((0, 0), size[1], size[0], angle=tilt, fill=False, color=_RED, lw=1.5))
        ax.set(xlabel=labels[i], ylabel=labels[j])
    axes[0].set_title('3000 draws of 2 µm noise')
    axes[1].set_title('ellipse: 95 % by the covariance')
    return figure


def appendix_d() -> Figure:
    """Where the code of Appendix D finds the right twist, a wrong one, or none."""
    geometry = thesis_geometry()
    dy, theta = np.meshgrid(np.linspace(-4e-3, 4e-3, 121), np.radians(np.linspace(-2, 2, 121)))
    # Random points, because a regular grid would beat with the trial angles.
    theta = theta + np.radians(0.03) * np.random.default_rng(4).uniform(-1.0, 1.0, theta.shape)
    poses = np.zeros((dy.size, 5))
    poses[:, 0], poses[:, 1], poses[:, 2] = 1e-4, dy.ravel(), theta.ravel()
    solution = make_solver('appendix_d', geometry).solve_many(dots_of(geometry, poses), VARIANCES)
    off = np.abs(solution.pose[:, 2] - poses[:, 2]) * MDEG
    off[solution.status != 0] = np.nan
    figure, ax = plt.subplots(figsize=(6.4, 3.8), layout='constrained')
    ax.grid(visible=False)
    extent = (-4.0, 4.0, -2.0, 2.0)
    silent = np.isnan(off).reshape(dy.shape)
    ax.imshow(silent, extent=extent, origin='lower', aspect='auto', interpolation='nearest', cmap='Greys', vmax=1.4)
    image = ax.imshow(
        np.log10(np.maximum(off, 1.0)).reshape(dy.shape),
        extent=extent,
        origin='lower',
        aspect='auto',
        interpolation='nearest',
        cmap=plt.get_cmap('viridis', 8),
        vmin=0.0,
        vmax=4.0,
    )
    bar = figure.colorbar(image, ticks=[0, 1, 2, 3, 4])
    bar.ax.set_yticklabels(['1', '10', '100', '1000', '10000'])
    bar.set_label('error of θ, mdeg')
    ax.set(
        xlabel='ΔY, mm',
        ylabel='twist, deg (counter-clockwise +)',
        title='grey: no trial passes, and (0, 0, 0) is returned',
    )
    return figure


def minimum_tilt() -> Figure:
    """Estimated against true tilt, with noise."""
    geometry = thesis_geometry()
    true = np.radians(np.linspace(0.0, 1.5, 61))
    along = (geometry.beams[0] - geometry.beams[1]) / np.hypot(*(geometry.beams[0] - geometry.beams[1]))
    rng = np.random.default_rng(2)
    figure, ax = plt.subplots(figsize=(6.0, 3.6), layout='constrained')
    for label, direction, color in (
        ('along the base line', along, _BLUE),
        ('about the base line', [-along[1], along[0]], _ORANGE),
    ):
        poses = np.zeros((len(true) * 30, 5))
        lean = np.repeat(true, 30)
        poses[:, 3], poses[:, 4] = -lean * direction[1], lean * direction[0]
        dots = dots_of(geometry, poses) + 2e-6 * rng.standard_normal((len(poses), 4))
        tilt = make_solver('minimum_tilt', geometry).solve_many(dots, VARIANCES).tilt
        ax.plot(np.degrees(lean), np.degrees(np.hypot(tilt[:, 0], tilt[:, 1])), '.', ms=2.5, color=color, label=label)
    ax.plot([0, 1.5], [0, 1.5], color='black', lw=0.8)
    ax.axvline(0.33, color=_GREY, ls=':')
    ax.text(0.34, 1.4, '50 N', color=_GREY)
    ax.set(
        xlabel='tilt of the plate, deg',
        ylabel='least tilt that explains the dots, deg',
        title='noise 2 µm; the sign is never seen',
    )
    ax.legend(fontsize=8, loc='center right')
    return figure


def beam() -> Figure:
    """Return the error of a flat method due to the cantilever's tilt, by load and height of the sensors."""
    figure, axes = plt.subplots(1, 2, figsize=(8.6, 3.4), sharey=True, layout='constrained')
    force = np.linspace(2.0, 50.0, 25)
    for ax, height in zip(axes, (0.0, 0.020), strict=True):
        nominal = thesis_geometry()
        geometry = Geometry(nominal.centers, nominal.zeros, np.full(2, height), nominal.link_length, 1.5)
        for k, color in ((1.5, _BLUE), (1.395, _GREEN), (2.0, _ORANGE)):
            poses = np.zeros((len(force), 5))
            poses[:, 0], poses[:, 1] = 0.12e-3 * force / 50.0, -2.2272e-3 * force / 50.0
            poses[:, 2] = np.radians(-0.9407) * force / 50.0
            poses = tied_pose(poses[:, :3], k, nominal.link_length)
            dots = dots_of(geometry, poses)
            for name, dash in (('exact', '--'), ('beam', '-')):
                off = make_solver(name, geometry).solve_many(dots, VARIANCES).pose - poses[:, :3]
                size = 1e6 * np.hypot(off[:, 0], off[:, 1])
                ax.plot(
                    force,
                    np.maximum(size, 1.2e-4),
                    dash,
                    lw=2 if k == 1.5 else 1.2,
                    color=color,
                    label=f'{name}, true k = {k:g}',
                )
        ax.set(
            xlabel='load on the sidebar, N',
            yscale='log',
            ylim=(1e-4, 300),
            title=f'surfaces {1e3 * height:g} mm above the section',
        )
    axes[0].set_ylabel('error of (ΔX, ΔY), µm')
    axes[0].text(4, 1.5e-4, 'beam, true k = 1.5: exact', color=_BLUE, fontsize=8)
    axes[0].legend(fontsize=7, ncols=2, loc='upper center')
    return figure


def pose() -> Figure:
    """How three PSDs at different heights make the tilts visible."""
    steps = np.geomspace(2e-3, 0.1, 25)
    angles = np.radians([0.0, 120.0, 240.0])
    centers = 0.1 * np.column_stack((np.cos(angles), np.sin(angles)))
    at = np.array([0.1e-3, -2e-3, -0.015, 0.0, 0.0])
    deviations = []
    for step in steps:
        deviation = pose_deviations(at, centers, np.array([step, -step / 2, -step / 2]), 2e-6)
        deviations.append(MDEG * deviation[[3, 4, 2]])
    figure, ax = plt.subplots(figsize=(5.8, 3.6), layout='constrained')
    for values, label, color in zip(
        np.transpose(deviations), ('phi', 'omega', 'theta'), (_BLUE, _ORANGE, _GREEN), strict=True
    ):
        ax.loglog(1e3 * steps, values, '.-', color=color, label=label)
    ax.set(xlabel='height of PSD 1, mm (the others half below)', ylabel='standard deviation, mdeg')
    ax.set_title('three PSDs on a circle of 100 mm, noise 2 µm')
    ax.legend(fontsize=8)
    return figure


def base_pair() -> Figure:
    """Return the error of section 5.3's method under twist, and its correction by tying the tilts to the deflection."""
    nominal = thesis_geometry()
    geometry = Geometry(nominal.centers, nominal.zeros, np.array([-0.585, -0.485]), nominal.link_length, 1.5)
    theta = np.radians(np.linspace(-1, 1, 81))
    poses = np.zeros((len(theta), 5))
    poses[:, 0], poses[:, 1], poses[:, 2] = 1e-3, -2e-3, theta
    poses = tied_pose(poses[:, :3], 1.5, nominal.link_length)
    rows = np.column_stack((geometry.beams, geometry.heights)).tolist()
    places = np.array(
        [
            [landing(row, (dx, dy, twist, phi, omega))[:2] for row in rows]
            for dx, dy, twist, phi, omega in poses.tolist()
        ]
    )
    dots = (places - geometry.centers).reshape(len(poses), -1)
    figure, (error_axes, travel_axes) = plt.subplots(1, 2, figsize=(8.6, 3.4), layout='constrained')
    for assume, color in (('no_twist', _RED), ('beam', _GREEN)):
        solution = make_solver('base_pair', geometry, assume=assume).solve_many(dots, VARIANCES).pose
        error_axes.plot(np.degrees(theta), 1e3 * (solution[:, 1] + 2e-3), color=color, label=f'assume {assume}')
    error_axes.set(xlabel='true twist, deg', ylabel='error of ΔY, mm', title='tip at (1, -2) mm, exact readings')
    error_axes.set_xticks([-1.0, -0.5, 0.0, 0.5, 1.0])
    error_axes.legend(fontsize=8)
    distance = np.linspace(0.0, 0.6, 61)
    for k, color in ((1.0, _ORANGE), (1.5, _BLUE), (2.0, _GREEN)):
        travel_axes.plot(1e3 * distance, 1.0 - k * distance / 0.585, color=color, label=f'k = {k:g}')
    travel_axes.axhline(0.0, color='black', lw=0.8)
    travel_axes.set(
        xlabel='lasers to PSD, mm',
        ylabel='dot travel per deflection',
        title='where a tilt hides the deflection (Fig. 5.9)',
    )
    travel_axes.legend(fontsize=8)
    return figure


def sensors() -> Figure:
    """Ratio of currents against the place of the spot."""
    x = np.linspace(-5e-3, 5e-3, 401)
    place = np.column_stack((x, 0.0 * x))
    figure, ax = plt.subplots(figsize=(5.8, 3.4), layout='constrained')
    lateral = Duolateral((0.010, 0.010), 0.5e-3)
    ax.plot(1e3 * x, lateral.to_ratios(place)[:, 0], color=_BLUE, label='lateral: duolateral, tetralateral, pincushion')
    for w, color in ((0.5e-3, _ORANGE), (2e-3, _GREEN)):
        quadrant = Quadrant((0.010, 0.010), w)
        ax.plot(
            1e3 * x, quadrant.to_ratios(place)[:, 0], color=color, label=f'quadrant, Gaussian spot, w = {1e3 * w:g} mm'
        )
        reach = quadrant.reach()[0]
        edge = quadrant.to_ratios(np.array([[reach, 0.0]]))[0, 0]
        ax.plot([-1e3 * reach, 1e3 * reach], [-edge, edge], 'o', color=color, ms=4)
    ax.set(xlabel='spot from the centre, mm', ylabel='difference over sum', ylim=(-1.1, 1.6))
    ax.legend(fontsize=8, loc='upper left')
    return figure


def large_spots() -> Figure:
    """Figures 5.30 to 5.35: both methods with dots of 1 mm (lines) and of 2 mm (marks), and the truth."""
    figure, axes = plt.subplots(3, 2, figsize=(9.0, 6.6), sharex=True, layout='constrained')
    units = np.array([MDEG / 1e3, 1e3, 1e3])
    for column, force in zip(axes.T, FORCES, strict=True):
        small, large = (spot_run(force, diameter) for diameter in DIAMETERS)
        for ax, axis, label, unit in zip(column, (2, 0, 1), ('θ, deg', 'ΔX, mm', 'ΔY, mm'), units, strict=True):
            ax.plot(small.t, unit * small.truth[:, axis], color='black', lw=0.8, label='truth')
            for method, color in zip(small.estimates, (_ORANGE, _BLUE), strict=True):
                ax.plot(small.t, unit * small.estimates[method][:, axis], color=color, lw=1.2, label=f'{method}, 1 mm')
                shown = slice(0, None, 5)
                ax.plot(
                    *(large.t[shown], unit * large.estimates[method][shown, axis], '.'),
                    color=color,
                    ms=4,
                    label=f'{method}, 2 mm',
                )
            ax.set(ylabel=label)
        column[0].set(title=f'{force:g} N on the sidebar')
        column[-1].set(xlabel='s')
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc='outside lower center', ncols=5, fontsize=8)
    return figure


FIGURES: dict[str, Callable[[], Figure]] = {
    'comparison': comparison,
    'sensors': sensors,
    'linear': linear,
    'iterative': iterative,
    'appendix_d': appendix_d,
    'exact': exact,
    'minimum_tilt': minimum_tilt,
    'beam': beam,
    'pose': pose,
    'base_pair': base_pair,
    'large_spots': large_spots,
}
