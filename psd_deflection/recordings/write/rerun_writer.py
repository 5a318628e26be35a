# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Writes a Rerun recording with its layout, in µm, mdeg and mm. A block without an estimate breaks the line; a lost one
appears only in the count of lost samples."""

import importlib.util
import math
from pathlib import Path
from typing import Any

import numpy as np

from psd_deflection.base.axes import AXES, SHOWN, SHOWN_UNITS, SYMBOLS
from psd_deflection.base.charts import GAP
from psd_deflection.base.errors import ConfigError, RecordingError
from psd_deflection.base.files import creating
from psd_deflection.model.plate.layout import bend, tip_boxes
from psd_deflection.records import DeflectionEstimate, Record, SpotMeans, TipLoad
from psd_deflection.rig.config import Rig

APPLICATION = 'psd_deflection'
TIMELINE = 'time'
POSE = tuple(zip(AXES, SYMBOLS, SHOWN_UNITS, SHOWN, ((75, 156, 240), (242, 142, 60), (64, 192, 130)), strict=True))
"""Entity, name, unit, how many of it make an SI unit, colour."""

_LOAD = (('fx', 'Fx (N)', POSE[0][4]), ('fy', 'Fy (N)', POSE[1][4]), ('tz', 'Tz (N m)', POSE[2][4]))
_LIGHT, _METAL, _SENSOR, _LOST = (255, 80, 60), (150, 160, 172), (90, 102, 117), (235, 80, 80)
_BATCH = 2000
"""Number of rows of an entity that are written together: Rerun's cost is per call."""
_TRAIL_S = 2.0
_STATIONS = np.linspace(0.0, 1.0, 9)
_EPOCH_NS = 10**17
"""Smaller times (before 1973) count from a start, not from the epoch."""

Row = tuple[float, ...] | None


def need_rerun() -> None:
    """Raise ConfigError, with the fix, if rerun is not installed."""
    # Not `rerun`: any folder of that name would match.
    if importlib.util.find_spec('rerun_bindings') is None:
        raise ConfigError(
            "an .rrd needs rerun: `pip install rerun-sdk` or `pip install 'psd_deflection[rerun]'` (170 MB), "
            'or draw the recording with psd-deflection plot'
        )


class RerunFile:
    """Estimates, dots, loads and losses as an ``.rrd``; a sink like any other.

    Raises ConfigError if rerun is not installed, RecordingError if the file exists or cannot be written.
    """

    def __init__(self, path: str | Path, rig: Rig, name: str = '') -> None:
        need_rerun()
        # Imported here: only an .rrd needs rerun.
        import rerun as rr

        self.path = Path(path)
        with creating(self.path):
            self.path.open('xb').close()
        self._rr = rr
        self._rig = rig
        self._block_ns = 1e9 * rig.estimator.block_size / rig.converter.sample_rate_hz
        self._magnify = rig.monitor.markers_magnify
        self._estimate: DeflectionEstimate | None = None
        self._load: TipLoad | None = None
        self._before: SpotMeans | None = None
        self._rows: dict[str, list[tuple[int, Row]]] = {}
        self._open: dict[str, bool] = {}
        self._closed = False
        self._stream = rr.RecordingStream(APPLICATION)
        self._stream.save(self.path, default_blueprint=blueprint(rig))
        self._stream.send_recording_name(name or self.path.stem)
        self._describe()

    def put(self, record: Record) -> None:
        """Take one record; a block's estimate and load come before its dots, as from the pipeline."""
        if isinstance(record, DeflectionEstimate) and record.primary:
            self._estimate = record
        elif isinstance(record, TipLoad):
            self._load = record
        elif isinstance(record, SpotMeans):
            self._gone(record)
            self._block(record)
            self._before, self._estimate, self._load = record, None, None

    def close(self) -> None:
        """Write the rest and close; a second call does nothing."""
        if self._closed:
            return
        self._closed = True
        for path in self._rows:
            self._write(path)
        try:
            self._stream.flush()
            self._stream.disconnect()
        except (OSError, RuntimeError, ValueError) as error:
            raise RecordingError(f'{self.path}: cannot be written ({error})') from None

    def _gone(self, s: SpotMeans) -> None:
        """Break every line where blocks are missing, whose samples count as lost, and at a step of the time map."""
        before = self._before
        if before is None:
            return
        step, blocks = s.t_ns - before.t_ns, s.index - before.index
        if blocks > 1:
            ends: tuple[int, ...] = (before.t_ns + round(step / blocks), s.t_ns - round(step / blocks))
            for t_ns in dict.fromkeys(ends):
                self._add('lost', t_ns, (s.present + s.lost,))
        elif 0.5 < step / self._block_ns < GAP:
            return
        else:
            ends = (before.t_ns + step // 2,)
        for path in self._open:
            if path != 'lost':
                self._add(path, ends[0], None)

    def _block(self, s: SpotMeans) -> None:
        t_ns, e, load = s.t_ns, self._estimate, self._load
        self._add('lost', t_ns, (s.lost,))
        pose = None if e is None else (e.dx, e.dy, e.theta)
        for i, (name, _, _, scale, _) in enumerate(POSE):
            if e is None or pose is None:
                value = band = None
            else:
                sd = 2.0 * max(e.variances[i], 0.0) ** 0.5
                value, band = (pose[i] * scale,), ((pose[i] - sd) * scale, (pose[i] + sd) * scale)
            self._add(f'tip/{name}', t_ns, value)
            self._add(f'tip/{name}/band', t_ns, band)
        for name, _, _ in _LOAD:
            self._add(f'load/{name}', t_ns, None if load is None else (getattr(load, name),))
        for i, psd in enumerate(self._rig.psds):
            x, y = s.dots[2 * i : 2 * i + 2]
            observed = s.sums[i] >= self._rig.estimator.sum_min and math.isfinite(x) and math.isfinite(y)
            self._add(f'sums/psd_{i + 1}', t_ns, (s.sums[i],))
            for path in ('dot', 'trail'):
                self._add(f'psd_{i + 1}/plane/{path}', t_ns, (1e3 * x, 1e3 * y) if observed else None)
            zx, zy = psd.center[0] + psd.zero[0], psd.center[1] + psd.zero[1]
            at = (zx + self._magnify * (x - psd.zero[0]), zy + self._magnify * (y - psd.zero[1]), psd.height)
            self._add(f'rig/tip/dot_{i + 1}', t_ns, at if observed and e is not None else None)
        moved = None if pose is None else tuple(self._magnify * v for v in pose)
        self._add('rig/link', t_ns, moved)
        self._add('rig/tip', t_ns, moved)
        # It does not change while it is visible.
        if moved is None or not self._open.get('rig/tip/plate'):
            self._add('rig/tip/plate', t_ns, moved)

    def _add(self, path: str, t_ns: int, row: Row) -> None:
        """Add a row of an entity; None, written once, if it has no value from now on."""
        if row is None and not self._open.get(path):
            return
        self._open[path] = row is not None
        rows = self._rows.setdefault(path, [])
        rows.append((t_ns, row))
        if len(rows) >= _BATCH:
            self._write(path)

    def _write(self, path: str) -> None:
        rows, self._rows[path] = self._rows[path], []
        if not rows:
            return
        t_ns = np.array([t for t, _ in rows], np.int64)
        values = np.array([row for _, row in rows if row is not None], np.float64)
        index = (
            self._rr.TimeColumn(TIMELINE, timestamp=t_ns.view('datetime64[ns]'))
            if t_ns[0] >= _EPOCH_NS
            else self._rr.TimeColumn(TIMELINE, duration=t_ns.view('timedelta64[ns]'))
        )
        columns, width = self._columns(path, values)
        columns = columns.partition([0 if row is None else width for _, row in rows])
        self._rr.send_columns(path, indexes=[index], columns=columns, recording=self._stream, strict=True)

    def _columns(self, path: str, values: Any) -> tuple[Any, int]:
        """Rerun's columns of rows (n, k), and how many instances a row has."""
        rr, rig = self._rr, self._rig
        if path.endswith(('/dot', '/trail')):
            return rr.Points2D.columns(positions=values.reshape(-1, 2)), 1
        if '/dot_' in path:
            return rr.Points3D.columns(positions=values.reshape(-1, 3)), 1
        if path == 'rig/link':
            dx, dy, _ = values.reshape(-1, 3).T
            shape = bend(_STATIONS)
            z = np.broadcast_to(_STATIONS * rig.link.length, (len(dx), len(shape)))
            return rr.LineStrips3D.columns(strips=np.stack([np.outer(dx, shape), np.outer(dy, shape), z], axis=-1)), 1
        if path == 'rig/tip':
            dx, dy, theta = values.reshape(-1, 3).T
            nothing = np.zeros_like(theta)
            at = np.stack([dx, dy, np.full_like(dx, rig.link.length)], axis=-1)
            quaternion = np.stack([nothing, nothing, np.sin(theta / 2.0), np.cos(theta / 2.0)], axis=-1)
            return rr.Transform3D.columns(translation=at, quaternion=quaternion), 1
        if path == 'rig/tip/plate':
            centers, sizes = zip(*tip_boxes(rig), strict=True)
            halves = [[side / 2.0 for side in size] for size in sizes]
            return rr.Boxes3D.columns(centers=centers * len(values), half_sizes=halves * len(values)), len(sizes)
        return rr.Scalars.columns(scalars=values.reshape(-1)), values.shape[1] if values.size else 1

    def _static(self, path: str, *what: Any) -> None:
        self._stream.log(path, *what, static=True, strict=True)

    def _describe(self) -> None:
        """The constant parts: names, colours, areas, lasers."""
        rr, rig = self._rr, self._rig
        for name, label, unit, _, color in POSE:
            self._static(f'tip/{name}', rr.SeriesLines(names=f'{label} ({unit})', colors=color, widths=1.5))
            style = rr.SeriesLines(names=['−2 sd', '+2 sd'], colors=[(*color, 90)] * 2, widths=0.8)
            self._static(f'tip/{name}/band', style)
        for name, label, color in _LOAD:
            self._static(f'load/{name}', rr.SeriesLines(names=label, colors=color))
        self._static('lost', rr.SeriesLines(names='samples lost a block', colors=_LOST, interpolation_mode='StepMid'))
        length = rig.link.length
        self._static('rig', rr.ViewCoordinates.RIGHT_HAND_Y_UP)
        self._static('rig/link', rr.LineStrips3D.from_fields(radii=rig.link.outer_radius, colors=_METAL))
        rest = rr.LineStrips3D([[(0, 0, 0), (0, 0, length)]], radii=rr.Radius.ui_points(1.0), colors=_METAL)
        self._static('rig/link_at_rest', rest)
        colors = [_METAL, *[_SENSOR] * len(rig.psds)]
        self._static('rig/tip/plate', rr.Boxes3D.from_fields(colors=colors, fill_mode='solid'))
        for i, psd in enumerate(rig.psds):
            n = i + 1
            width, height = (1e3 * side for side in psd.active_area)
            area = rr.Boxes2D(sizes=[(width, height)], centers=[(0.0, 0.0)], colors=_SENSOR)
            cross = [[(-width / 2, 0.0), (width / 2, 0.0)], [(0.0, -height / 2), (0.0, height / 2)]]
            # Rerun's second axis points down, a detector's up.
            self._static(f'psd_{n}/plane', rr.Transform3D(mat3x3=np.diag([1.0, -1.0, 1.0])))
            self._static(f'psd_{n}/plane/area', area)
            self._static(f'psd_{n}/plane/axes', rr.LineStrips2D(cross, colors=(*_SENSOR, 90)))
            self._static(f'psd_{n}/plane/dot', rr.Points2D.from_fields(colors=_LIGHT, radii=rr.Radius.ui_points(5.0)))
            trail = rr.Points2D.from_fields(colors=(*_LIGHT, 110), radii=rr.Radius.ui_points(1.5))
            self._static(f'psd_{n}/plane/trail', trail)
            self._static(f'sums/psd_{n}', rr.SeriesLines(names=f'sum{n} (V)', colors=POSE[i % len(POSE)][4]))
            x, y = psd.center[0] + psd.zero[0], psd.center[1] + psd.zero[1]
            beam = rr.LineStrips3D(
                [[(x, y, 0.0), (x, y, length + psd.height)]], radii=rr.Radius.ui_points(0.8), colors=_LIGHT
            )
            self._static(f'rig/beam_{n}', beam)
            self._static(
                f'rig/laser_{n}', rr.Boxes3D(centers=(x, y, -0.02), sizes=(0.016, 0.016, 0.04), colors=_SENSOR)
            )
            self._static(f'rig/tip/dot_{n}', rr.Points3D.from_fields(colors=_LIGHT, radii=2.0 * psd.spot_radius))


def blueprint(rig: Rig, speed: float = 1.0) -> Any:
    """The layout: traces on the left; on the right both detectors, the rig in space, loads and sums.

    ``speed``: playback speed; playback starts at once.
    """
    import rerun.blueprint as rrb

    def traces(origin: str, name: str, legend: bool = False, most: float | None = None) -> Any:
        return rrb.TimeSeriesView(
            origin=origin,
            name=name,
            axis_x=rrb.TimeAxis(link='LinkToGlobal'),
            axis_y=None if most is None else rrb.ScalarAxis(range=(0.0, most)),
            plot_legend=rrb.PlotLegend(rrb.Corner2D.LeftBottom, visible=legend),
        )

    def detector(number: int) -> Any:
        width, height = (0.54e3 * side for side in rig.psds[number - 1].active_area)
        trail = rrb.VisibleTimeRanges(
            timeline=TIMELINE,
            start=rrb.TimeRangeBoundary.cursor_relative(seconds=-_TRAIL_S),
            end=rrb.TimeRangeBoundary.cursor_relative(),
        )
        return rrb.Spatial2DView(
            origin=f'psd_{number}',
            name=f'PSD {number} (mm)',
            visual_bounds=rrb.VisualBounds2D(x_range=(-width, width), y_range=(-height, height)),
            overrides={f'psd_{number}/plane/trail': trail},
        )

    magnify = f'{rig.monitor.markers_magnify:g}'
    length = rig.link.length
    space = rrb.Spatial3DView(
        origin='rig',
        name=f'Rig, displacements × {magnify}',
        eye_controls=rrb.EyeControls3D(
            position=(-0.8 * length, 0.46 * length, -0.28 * length), look_target=(-0.04, 0.0, 0.42 * length)
        ),
        line_grid=False,
    )
    left_column = rrb.Vertical(
        *(traces(f'tip/{name}', f'{label} ({unit}), ± 2 sd') for name, label, unit, _, _ in POSE), row_shares=[5, 5, 6]
    )
    detectors = [detector(n) for n in range(1, len(rig.psds) + 1)]
    right_column = rrb.Vertical(
        rrb.Horizontal(*detectors, space, column_shares=[*[3] * len(detectors), 4]),
        traces('load', 'Load at the tip (N, N m)', True),
        traces('sums', 'Sums (V)', True, 1.1 * rig.amplifier.sum_nominal),
        traces('lost', 'Samples lost a block', most=1.05 * rig.estimator.block_size),
        row_shares=[10, 10, 7, 5],
    )
    return rrb.Blueprint(
        rrb.Horizontal(left_column, right_column, column_shares=[1, 1]),
        rrb.TimePanel(
            state='collapsed', timeline=TIMELINE, play_state='playing', playback_speed=speed, loop_mode='all'
        ),
        rrb.SelectionPanel(state='collapsed'),
        rrb.BlueprintPanel(state='collapsed'),
        auto_layout=False,
        auto_views=False,
    )
