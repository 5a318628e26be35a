# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Draw a recording: deflection and twist with their uncertainty, dots, sums, spectrum and losses.

The estimates are computed as by `replay`, with the recorded parameters or those of --params-file. Known
loads, references, marks and zeros of the recording are drawn too. The ending of --out sets the format: .png,
.svg, .pdf, or .html: one self-contained page with values under the cursor and zoom.
`median sd` is the median of the standard deviations that the estimates state.

  psd-deflection plot bags/lost_samples
  psd-deflection plot bags/clean --from 1.5 --to 3
  psd-deflection plot run.csv --params-file my_rig.yaml --out run.html
"""

import argparse
import os
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from psd_deflection.base.axes import AXES, SHOWN, SHOWN_UNITS, SYMBOLS
from psd_deflection.base.charts import GAP
from psd_deflection.base.errors import RecordingError, UsageError
from psd_deflection.base.text import sanitize
from psd_deflection.cli._options import PICTURES, namespace_option, need_folder, picture_name, span_options
from psd_deflection.cli._plot_page import DrawnInputs, plot_page
from psd_deflection.cli._progress import progress_of, stage
from psd_deflection.cli._report import print_json, save, save_figure, show, warn
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.recordings.formats.format import endings_of_recordings
from psd_deflection.recordings.recording import Recording
from psd_deflection.recordings.replay.engine import open_for_replay, replayed, warnings_about_rig
from psd_deflection.recordings.spans import FULL, span_ns
from psd_deflection.records import (
    BlockStatus,
    DeflectionEstimate,
    FloatArray,
    Record,
    SampleBlock,
    SpotMeans,
    dot_names,
)
from psd_deflection.rig.config import Rig
from psd_deflection.run.monitor.feed import is_zero
from psd_deflection.run.monitor.spectrum import Spectrum

SPECTRUM_OF_S = 600.0
"""The spectrum is of the last ten minutes: it does not get better after that, only slower."""

LONGEST_NAME = 200
"""Characters of a recording's name in the figure."""

MOST_REFERENCES = 500
EVER = (-(2**63), 2**63)

MOST_WORDS, LONGEST_WORDS = 50, 40
"""Marks whose text is written, and its characters."""

COLORS = {
    'dx': '#0b6bcb',
    'dy': '#c2570c',
    'theta': '#0f7b4f',
    'lost': '#c62828',
    'quiet': '#5a6875',
    'mark': '#7b1fa2',
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument('recording', metavar='REC', help='a bag folder, an .mcap or a .csv')
    parser.add_argument('--params-file', metavar='RIG.yaml', help='use this rig instead of the recorded parameters')
    parser.add_argument(
        '--out',
        type=picture_name(*PICTURES, '.html'),
        metavar='OUT',
        help='.png, .svg, .pdf or .html (default: REC.png in this folder)',
    )
    span_options(parser)
    namespace_option(parser)
    parser.add_argument('--json', action='store_true', help='print the summary as JSON, in SI units')


@dataclass
class Drawn:
    """What is drawn, a row a block: s, m, m, rad, V; NaN where a block has no estimate.

    ``numbers``: of the first and the last sample. ``first``, ``last``: the blocks at the ends, which a
    start or a stop amid a block leaves unfinished. ``window``: what is drawn of the recording, from and before
    these times, ns; its first block was at ``start_ns``. ``zeros``: when a zero was taken, ns.
    """

    recording: Recording
    window: tuple[int, int] = EVER
    start_ns: int | None = None
    numbers: tuple[int, int] | None = None
    first: SampleBlock | None = None
    last: SampleBlock | None = None
    _inside: bool = True
    spots: list[SpotMeans] = field(default_factory=list)
    estimates: dict[int, DeflectionEstimate] = field(default_factory=dict)
    zeros: list[int] = field(default_factory=list)

    def add(self, record: Record) -> bool:
        """Take what is drawn of a record; return whether it is within the window."""
        if isinstance(record, SpotMeans | DeflectionEstimate):
            self.start_ns = record.t_ns if self.start_ns is None else self.start_ns
            self._inside = self.window[0] <= record.t_ns < self.window[1]
        if is_zero(record):
            self.zeros.append(record.t_ns)
        if not self._inside:
            return False
        if isinstance(record, SpotMeans):
            self.spots.append(record)
        elif isinstance(record, DeflectionEstimate) and record.primary:
            self.estimates[record.block] = record
        elif isinstance(record, SampleBlock):
            first, last = int(record.seq[0]), int(record.seq[-1])
            self.numbers = (first if self.numbers is None else self.numbers[0], last)
            self.first = self.first or record
            self.last = record
        return True

    @property
    def ended(self) -> bool:
        """Whether the window lies before the record that was added last."""
        return bool(self.spots) and not self._inside

    def inputs(self) -> DrawnInputs:
        """Loads, references, zeros and marks within the window; first the load that is held when it begins."""
        first = self.spots[0].t_ns
        last = self.spots[-1].t_ns
        loads = sorted((r for r in self.recording.loads() if r.t_ns <= last), key=lambda r: r.t_ns)
        before = [load._replace(t_ns=first) for load in loads if load.t_ns <= first][-1:]
        references = [r for r in self.recording.references() if first <= r.t_ns <= last]
        zeros = [z for z in self.zeros if first <= z <= last]
        return DrawnInputs(
            loads=[*before, *(r for r in loads if r.t_ns > first)],
            references=references,
            zeros=zeros,
            marks=[m for m in self.recording.marks() if self._covers(m.t_ns)],
            start_ns=self.start_ns or 0,
        )

    def _covers(self, t_ns: int) -> bool:
        """Whether a moment lies within the window, and within what was recorded."""
        if self.first is None or self.last is None or not self.window[0] <= t_ns < self.window[1]:
            return False
        # A block's stamp is its middle; what is beside the window has no sample here.
        margin = int(self.first.t_ns[-1] - self.first.t_ns[0]) + 1
        return int(self.first.t_ns[0]) - margin <= t_ns <= int(self.last.t_ns[-1]) + margin

    def table(self) -> dict[str, FloatArray]:
        """Arrays (n,): t from the first block, pose, standard deviations, dots, sums, samples lost, 1 if unfinished."""
        start = self.start_ns if self.start_ns is not None else self.spots[0].t_ns
        nothing = (np.nan,) * 6
        rows: list[tuple[float, ...]] = []
        index = self.spots[0].index - 1
        numbered = np.array([(s.t_ns - start, s.index) for s in self.spots], np.float64)
        steps, numbers = np.diff(numbered, axis=0).T
        period = float(np.median(steps / numbers)) / 1e9 if len(steps) else 0.0
        for s in self.spots:
            if s.index != index + 1 and rows:
                # Blocks that are gone altogether break the line, from the first to the last of them.
                step = ((s.t_ns - start) / 1e9 - rows[-1][0]) / (s.index - index)
                before = rows[-1][0]
                for k in (1, s.index - index - 1):
                    rows.append((before + k * step, *nothing, *(np.nan,) * (3 * len(s.sums) + 1), 0.0))
            elif rows and not 0.5 * period < (step := (s.t_ns - start) / 1e9 - rows[-1][0]) < GAP * period:
                # So does a step of the time map.
                rows.append((rows[-1][0] + 0.5 * step, *nothing, *(np.nan,) * (3 * len(s.sums) + 1), 0.0))
            index = s.index
            e = self.estimates.get(s.index)
            pose = nothing if e is None else (*e.pose, *(max(v, 0.0) ** 0.5 for v in e.variances))
            lost = self._lost(s)
            unfinished = s.status is BlockStatus.TOO_FEW_SAMPLES and lost == 0
            rows.append(((s.t_ns - start) / 1e9, *pose, *s.dots, *s.sums, float(lost), float(unfinished)))
        psds = len(self.spots[0].sums) if self.spots else 2
        pose_names = ('dx', 'dy', 'theta', 'sd_dx', 'sd_dy', 'sd_theta')
        sums = (f'sum{n}' for n in range(1, psds + 1))
        names = ('t', *pose_names, *dot_names(psds), *sums, 'lost', 'unfinished')
        columns = np.array(rows, np.float64).T
        return dict(zip(names, columns, strict=True))

    def _lost(self, spots: SpotMeans) -> int:
        """Samples lost of a block: of one at an end those between its own first and last, as in ``gone``."""
        size = spots.present + spots.lost
        lost = self.recording.lost(spots.index * size, (spots.index + 1) * size - 1, spots.present)
        for block in (self.first, self.last):
            if block is not None and block.index == spots.index:
                lost = min(lost, int(block.seq[-1] - block.seq[0]) + 1 - len(block.seq))
        return lost

    def seconds(self) -> float:
        """How long the samples last, by their stamps."""
        if self.first is None or self.last is None:
            return 0.0
        return self.recording.lasts(int(self.first.t_ns[0]), int(self.last.t_ns[-1]))

    def gone(self) -> int:
        """Samples that are missing between the first and the last one."""
        if self.numbers is None:
            return 0
        return self.recording.lost(*self.numbers, sum(s.present for s in self.spots))


def run(args: argparse.Namespace) -> int:
    """Read, replay, draw."""
    # A name that is no text is shown as far as it is one.
    name, title = (
        sanitize(os.fsencode(n).decode(errors='replace'), LONGEST_NAME)
        for n in (Path(args.recording).resolve().name, args.recording)
    )
    out = Path(args.out) if args.out is not None else default_out(args.recording)
    need_folder(out)
    recording, rig = open_for_replay(args.recording, args.params_file, args.namespace)
    for warning in warnings_about_rig(recording, args.params_file):
        warn(warning)
    window = EVER
    if args.span != FULL:
        start_ns = next(int(block.t_ns[0]) for block in recording.blocks())
        window = span_ns(recording, start_ns, args.span)
        if window[0] >= window[1]:
            raise UsageError(f'--from {args.span[0]} --to {args.span[1]}: must rise')
    drawn, spectrum = Drawn(recording, window), Spectrum(rig, SPECTRUM_OF_S)
    for records in replayed(recording, Pipeline(rig), progress_of(recording.blocks(), quiet=args.json)):
        for record in records:
            if drawn.add(record) and isinstance(record, SampleBlock):
                spectrum.add(record)
        if drawn.ended:
            break
    if not drawn.spots:
        part = '' if args.span == FULL else ' between --from and --to'
        raise RecordingError(f'{args.recording}: has no samples to draw{part}')
    summary = summarise(drawn, rig)
    with stage('drawing', quiet=args.json):
        if out.suffix.lower() == '.html':
            density = spectrum.density()
            shape = None if density is None else (spectrum.frequencies, density)
            page = plot_page(title, drawn.table(), shape, drawn.inputs(), rig, summary)
            save(page.encode(), out)
        else:
            save_figure(draw_recording(drawn, spectrum, rig, name), out, dpi=150)
    if args.json:
        print_json({**plot_json(drawn, rig), 'out': str(out)})
        return 0
    for name, value in summary:
        show(f'{name:<24} {value}')
    show(f'written to {out}')
    return 0


def default_out(recording: str) -> Path:
    """A .png here, named like the recording; a folder's name may have dots in it."""
    path = Path(recording).resolve()
    is_file = path.suffix.lower() in endings_of_recordings() and not path.is_dir()
    return Path(f'{path.stem if is_file else path.name}.png')


def plot_json(drawn: Drawn, rig: Rig) -> dict[str, Any]:
    """What ``--json`` prints: counts, s, m and rad."""
    table = drawn.table()
    causes = Counter(s.status.name.lower() for s in drawn.spots if s.reason)
    out: dict[str, Any] = {
        'duration_s': drawn.seconds(),
        'samples': sum(s.present for s in drawn.spots),
        'lost': drawn.gone(),
        'blocks': len(drawn.spots),
        'estimates': len(drawn.estimates),
        'solver': rig.estimator.solver,
        'without_estimate': dict(sorted(causes.items())),
    }
    for name, *_ in _POSE:
        values = table[name][np.isfinite(table[name])]
        if len(values):
            sd = float(np.nanmedian(table[f'sd_{name}']))
            out[name] = {'min': float(values.min()), 'max': float(values.max()), 'sd': sd}
    return out


def summarise(drawn: Drawn, rig: Rig) -> list[tuple[str, str]]:
    """Name and value, for the terminal and the page."""
    f = plot_json(drawn, rig)
    present, lost = f['samples'], f['lost']
    rows = [
        ('duration', f'{f["duration_s"]:.3f} s'),
        ('samples', f'{present} present, {lost} lost ({100.0 * lost / (present + lost):.3g} %)'),
        ('estimates', f'{f["estimates"]} of {f["blocks"]} blocks ({f["solver"]})'),
    ]
    rows += [
        (f'without: {cause.replace("_", " ")}', f'{n} block' if n == 1 else f'{n} blocks')
        for cause, n in f['without_estimate'].items()
    ]
    for name, label, scale, unit in _POSE:
        if name in f:
            low, high, sd = (f[name][k] * scale for k in ('min', 'max', 'sd'))
            rows.append((label, f'{low:+.2f} … {high:+.2f} {unit}, median sd {sd:.2f} {unit}'))
    return rows


_POSE = tuple(zip(AXES, SYMBOLS, SHOWN, SHOWN_UNITS, strict=True))


def draw_recording(drawn: Drawn, spectrum: Spectrum, rig: Rig, name: str) -> Any:
    """The figure: four traces on the left, both detectors and the spectrum on the right."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    table, inputs = drawn.table(), drawn.inputs()
    t = table['t']
    # Paths of an hour's blocks are pictures, not paths, else an .svg of them chokes its reader.
    raster = len(t) > 20_000
    with mpl.rc_context({'font.size': 9, 'axes.grid': True, 'grid.alpha': 0.3, 'axes.axisbelow': True}):
        figure = Figure(figsize=(13, 8), layout='constrained')
        figure.suptitle(f'{name} · {len(drawn.estimates)} estimates, {drawn.gone()} samples lost')
        heights = (3, 3, 3, 1.6, *([1.6] if inputs.loads else []))
        # In twelfths, so that the detectors share one half of the width.
        grid = figure.add_gridspec(len(heights), 12, height_ratios=heights)
        traces = [figure.add_subplot(grid[0, :6])]
        traces += [figure.add_subplot(grid[i, :6], sharex=traces[0]) for i in range(1, len(heights))]
        for axes, (key, label, scale, unit) in zip(traces, _POSE, strict=False):
            value, sd = table[key] * scale, table[f'sd_{key}'] * scale
            axes.fill_between(
                t, value - 2 * sd, value + 2 * sd, color=COLORS[key], alpha=0.3, linewidth=0, rasterized=raster
            )
            axes.plot(t, value, color=COLORS[key], linewidth=0.8, rasterized=raster)
            typical = f', band ±2 sd, median sd {np.nanmedian(sd):.2f} {unit}' if np.isfinite(sd).any() else ''
            axes.set_ylabel(f'{label} ({unit})')
            axes.set_title(f'{label}{typical}', loc='left', fontsize=9)
            _mark_losses(axes, table)
            _mark_inputs(axes, inputs, key, scale)
            _marks(axes, inputs)
        if traces[0].get_legend_handles_labels()[0]:
            traces[0].legend(loc='upper right', fontsize=8)
        sums = [f'sum{n}' for n in range(1, len(rig.psds) + 1)]
        for key, color in zip(sums, _SUMS, strict=False):
            traces[3].plot(t, table[key], color=color, linewidth=0.9, label=key, rasterized=raster)
        traces[3].axhline(rig.estimator.sum_min, color=COLORS['quiet'], linestyle=':', linewidth=1)
        traces[3].set(
            ylabel='sum (V)', ylim=(0.0, 1.2 * max(rig.amplifier.sum_nominal, *(np.nanmax(table[key]) for key in sums)))
        )
        traces[3].legend(loc='center right', fontsize=8, ncols=len(sums))
        if inputs.loads:
            _loads(traces[4], inputs, float(t[-1]))
        for axes in traces[len(_POSE) :]:
            _marks(axes, inputs)
        for mark in inputs.marks[:MOST_WORDS]:
            words = sanitize(mark.text, LONGEST_WORDS)
            at = inputs.seconds(mark.t_ns)
            where = traces[0].get_xaxis_transform()
            traces[0].text(at, 0.97, f' {words}', rotation=90, fontsize=7, va='top', transform=where, clip_on=True)
        traces[-1].set_xlabel('t (s)')
        for number in range(1, len(rig.psds) + 1):
            _detector(figure.add_subplot(grid[_place(number, len(rig.psds))]), table, rig, number, raster)
        _spectrum(figure.add_subplot(grid[2:, 6:]), spectrum, rig)
    return figure


_SUMS = (COLORS['dx'], COLORS['dy'], '#0f7b4f', '#8b3fa8', '#a52a4a', '#5a6472')
_DOTS = (
    *('#0b6bcb', '#5aa2e6', '#c2570c', '#e8a15f', '#0f7b4f', '#66b594'),
    *('#8b3fa8', '#b98bca', '#a52a4a', '#cf8599', '#5a6472', '#9aa3ae'),
)


def _place(number: int, psds: int) -> tuple[slice, slice]:
    """Rows and twelfths of detector ``number`` in the figure: up to three side by side, more in two rows."""
    if psds <= 3:
        wide = 6 // psds
        return slice(0, 2), slice(6 + wide * (number - 1), 6 + wide * number)
    row, column = divmod(number - 1, 3)
    return slice(row, row + 1), slice(6 + 2 * column, 8 + 2 * column)


def _mark_losses(axes: Any, table: dict[str, FloatArray]) -> None:
    """Red ticks where samples are missing, grey where there is no estimate."""
    t, none, lost = table['t'], ~np.isfinite(table['dx']) & (table['unfinished'] == 0), ~(table['lost'] == 0)
    edges = np.flatnonzero(np.diff(np.concatenate(([False], none, [False])).astype(int)))
    half = float(np.median(np.diff(t))) / 2.0 if len(t) > 1 else 0.0
    for i, (first, end) in enumerate(edges.reshape(-1, 2)):
        axes.axvspan(
            t[first] - half,
            t[end - 1] + half,
            color=COLORS['quiet'],
            alpha=0.18,
            lw=0,
            label='' if i else 'no estimate',
        )
    if lost.any():
        where = axes.get_xaxis_transform()
        axes.plot(
            t[lost], np.ones(int(lost.sum())), '|', color=COLORS['lost'], ms=9, transform=where, label='lost samples'
        )


def _mark_inputs(axes: Any, inputs: DrawnInputs, name: str, scale: float) -> None:
    """Rings where a reference was, a dashed line where the zero was taken or the load changed."""
    if inputs.references:
        at = [inputs.seconds(r.t_ns) for r in inputs.references]
        values = [getattr(r, name) * scale for r in inputs.references]
        every = max(1, len(at) // MOST_REFERENCES)
        axes.plot(
            at[::every], values[::every], 'o', ms=3, mfc='none', color=COLORS['quiet'], alpha=0.8, label='reference'
        )
    for i, zero in enumerate(inputs.zeros):
        axes.axvline(inputs.seconds(zero), color=COLORS['lost'], ls='--', lw=1, label='' if i else 'zero taken')
    for load in inputs.loads[1:]:
        axes.axvline(inputs.seconds(load.t_ns), color=COLORS['quiet'], ls='--', lw=0.6)


def _marks(axes: Any, inputs: DrawnInputs) -> None:
    """A line where somebody set a mark."""
    for mark in inputs.marks:
        axes.axvline(inputs.seconds(mark.t_ns), color=COLORS['mark'], lw=0.9)


def _loads(axes: Any, inputs: DrawnInputs, end: float) -> None:
    """The known load: forces on the left, the torque on the right."""
    loads = inputs.loads
    at = [*(inputs.seconds(r.t_ns) for r in loads), end]
    twin = axes.twinx()
    lines = []
    for name, unit, color, where in (
        ('fx', 'N', COLORS['dx'], axes),
        ('fy', 'N', COLORS['dy'], axes),
        ('tz', 'N m', COLORS['theta'], twin),
    ):
        values = [getattr(r, name) for r in (*loads, loads[-1])]
        lines += where.step(
            at, values, where='post', color=color, lw=0.9, ls='--' if where is twin else '-', label=f'{name} ({unit})'
        )
    axes.set_ylabel('load (N)')
    twin.set_ylabel('(N m)')
    twin.grid(visible=False)
    axes.legend(handles=lines, loc='upper right', fontsize=8, ncols=3)


def _detector(axes: Any, table: dict[str, FloatArray], rig: Rig, number: int, raster: bool) -> None:
    from matplotlib.patches import Rectangle

    width, height = (1e3 * side for side in rig.psds[number - 1].active_area)
    axes.add_patch(Rectangle((-width / 2, -height / 2), width, height, fill=False, color=COLORS['quiet']))
    x, y = table[f'x{number}'] * 1e3, table[f'y{number}'] * 1e3
    observed = np.isfinite(table['dx'])
    axes.plot(x[observed], y[observed], '.', ms=2.5, color=COLORS['lost'], alpha=0.5, rasterized=raster)
    axes.set(
        aspect='equal',
        xlim=(-0.54 * width, 0.54 * width),
        ylim=(-0.54 * height, 0.54 * height),
        xlabel=f'x{number} (mm)',
        ylabel=f'y{number} (mm)',
    )
    axes.set_title(f'PSD {number}, active area', loc='left', fontsize=9)


def _spectrum(axes: Any, spectrum: Spectrum, rig: Rig) -> None:
    density = spectrum.density()
    axes.set_title('spectrum of the dots', loc='left', fontsize=9)
    axes.set(xlabel='f (Hz)', ylabel='µm/√Hz', xscale='log', yscale='log')
    if density is None:
        axes.text(
            0.5, 0.5, 'no stretch with light and without a loss is long enough', transform=axes.transAxes, ha='center'
        )
        return
    for channel, color, values in zip(dot_names(len(rig.psds)), _DOTS, density, strict=False):
        if (values > 0.0).any():
            axes.plot(spectrum.frequencies, values * 1e6, color=color, linewidth=0.9, label=channel)
    for hertz, label in ((rig.dynamics.bending_frequency, 'bending'), (rig.dynamics.torsion_frequency, 'torsion')):
        axes.axvline(hertz, color=COLORS['quiet'], linestyle=':', linewidth=1)
        axes.text(hertz, 0.02, f' {label}', rotation=90, transform=axes.get_xaxis_transform(), fontsize=8, va='bottom')
    axes.legend(loc='upper right', fontsize=8, ncols=2)
