// Copyright 2026 psd_deflection maintainers
// SPDX-License-Identifier: Apache-2.0
// The traces, of the last minute or of the daemon's history, and the spectrum.

import { hours } from '/page/cells.js';
import { calm, cursor, dragged, edge, eventMarks, Legend, line, logarithmic, logarithms, lossMarks, modeMarks, options, referenceMarks } from '/page/charts.js';

const SOONER = [5, 10, 30];
const TIMED = ['shift', 'theta', 'sums'];
const BANDS = { false: 'band ±2 sd', true: 'band least to greatest' };
const MICRO = 1e6;
const MDEG = (180 / Math.PI) * 1e3;
const SCALES = { dx: MICRO, dy: MICRO, theta: MDEG };
const NARROW = 500;

export class Plots {
  // `zoomed` gets the stretch of the traces that is chosen, null if a double click leaves it.
  constructor(hello, color, references, zoomed, each) {
    this.state = { losses: [], marks: [], references: [[], [], [], []], from: 0, to: 1 };
    // Of the last minute.
    this.marks = this.state.marks;
    // Of the history, while it is looked at.
    this.cells = null;
    this.each = each;
    this.color = color;
    this.hello = hello;
    this.references = references;
    this.band = null;
    this.zoom = (range) => {
      if (range) [this.state.from, this.state.to] = range;
      zoomed(range);
      if (range) for (const name of TIMED) this.plots[name].setData(this.plots[name].data);
    };
    this.elements = Object.fromEntries([...TIMED, 'spectrum'].map((n) => [n, document.getElementById(`plot_${n}`)]));
    this.legend = new Legend((name) => this.plots[name]);
    this.watch = new ResizeObserver(() => this.resize());
    this.build();
    for (const element of Object.values(this.elements)) this.watch.observe(element);
  }

  // `kept`: what is shown stays, in other colours or on other scales.
  build(kept = false) {
    const { color, elements, hello, legend } = this;
    legend.find();
    this.psds = hello.active_areas.map((_, i) => i + 1);
    this.sums = this.psds.map((n) => `sum${n}`);
    const dots = this.psds.flatMap((n) => [`--x${n}`, `--y${n}`]);
    this.kept = kept ? Object.fromEntries(Object.entries(this.plots).map(([name, plot]) => [name, plot.data])) : {};
    for (const plot of Object.values(this.plots || {})) plot.destroy();
    for (const words of document.querySelectorAll('.band')) words.textContent = BANDS[this.cells !== null];
    const [f0, bins] = hello.frequency;
    this.frequencies = Array.from({ length: bins }, (_, i) => f0 * (i + 1));
    const spectral = (range) => {
      this.band = range;
      this.plots.spectrum.setData(this.plots.spectrum.data);
    };
    this.plots = {
      shift: this.shift(),
      theta: this.timed('theta', [line(color('--theta')), edge, edge], { scales: { y: { range: calm(0.5) } }, fills: [['--theta', 'theta', 1]] }),
      sums: this.timed('sums', this.psds.map((n) => line(color(sumColor(n)))), {
        scales: { y: { range: () => [0, 1.5 * hello.sum_nominal] } }, fills: this.psds.map((n) => [sumColor(n), `sum${n}`, n]), banded: false,
      }),
      spectrum: new uPlot(options(color, elements.spectrum, dots.map((n) => line(color(n), 1)), {
        scales: { x: { time: false, distr: 3, range: () => this.band ?? [f0, f0 * bins] }, y: { distr: 3 } },
        cursor: cursor(spectral),
        hooks: { drawAxes: [modeMarks(color, hello.modes, this.frequencies.at(-1))], setCursor: [legend.follow('spectrum', 3)], setSelect: [dragged(spectral)] },
        x: { splits: logarithmic, values: logarithms },
        y: { splits: logarithmic, values: logarithms },
      }), [this.frequencies, ...dots.map(() => this.frequencies.map(() => null))], elements.spectrum),
    };
    for (const name of Object.keys(this.plots)) legend.apply(name);
  }

  // ΔX and ΔY on one scale, or each on its own: then its axis has its colour and its name.
  shift() {
    const { color, each } = this;
    const own = each ? { scale: 'dy' } : {};
    const axis = (name) => ({ label: `Δ${name.at(-1).toUpperCase()} (µm)`, labelSize: 18, labelFont: '11px system-ui, sans-serif', stroke: color(name) });
    const second = { ...axis('--dy'), scale: 'dy', side: 1, grid: { show: false } };
    return this.timed('shift', [line(color('--dx')), edge, edge, { ...line(color('--dy')), ...own }, { ...edge, ...own }, { ...edge, ...own }], {
      scales: { y: { range: calm(1) }, ...(each ? { dy: { range: calm(1) } } : {}) },
      fills: [['--dx', 'dx', 1], ['--dy', 'dy', 4]],
      axes: each ? [axis('--dx'), second] : [],
    });
  }

  // A plot over time. `fills`: colour, name and series of what has a band. `axes`: what the left one has besides, and a second.
  timed(name, series, { scales, fills, axes = [], banded = true }) {
    const { color, state, legend } = this;
    const element = this.elements[name];
    const ofCells = this.cells !== null;
    const narrow = element.clientWidth < NARROW ? { size: 48 } : {};
    const draw = [eventMarks(color, state)];
    if (name !== 'sums') draw.unshift(lossMarks(color, state), this.referenceRings(fills));
    if (ofCells) draw.unshift(this.envelopes(fills), this.unestimated());
    const made = options(color, element, series, {
      // uPlot fills from the upper edge down.
      bands: banded && !ofCells ? fills.map(([tint, , i]) => ({ series: [i + 2, i + 1], fill: `${color(tint)}33` })) : [],
      scales: { x: { time: false, range: () => [state.from, state.to] }, ...scales },
      cursor: cursor(this.zoom, 'traces'),
      hooks: { draw, setCursor: [legend.follow(name), ...(ofCells && name === 'shift' ? [(u) => this.tell(u)] : [])], setSelect: [dragged(this.zoom)] },
      x: ofCells ? hours : {},
      y: { ...narrow, ...axes[0] },
      // As far to the right as the axis of the plot above.
      ...(this.each && !axes.length ? { padding: [6, narrow.size ? 74 : 88, 0, 18] } : {}),
    });
    if (axes[1]) made.axes.push({ ...made.axes[1], ...narrow, ...axes[1] });
    return new uPlot(made, this.kept[name] ?? Array.from({ length: series.length + 1 }, () => []), element);
  }

  referenceRings(fills) {
    const at = { dx: 1, dy: 2, theta: 3 };
    return referenceMarks(this.color, () => [this.state.references[0], ...fills.map(([tint, name, i]) => [tint, this.state.references[at[name]], i])]);
  }

  // From the least to the greatest value of each cell, as wide as it is; a cell between gaps has its mean as a dash.
  envelopes(fills) {
    return (u) => {
      const g = u.ctx;
      const { t, width } = this.cells;
      const ratio = window.devicePixelRatio || 1;
      g.save();
      g.beginPath();
      g.rect(u.bbox.left, u.bbox.top, u.bbox.width, u.bbox.height);
      g.clip();
      for (const [tint, name, i] of fills) {
        const { show, scale } = u.series[i];
        if (!show) continue;
        const y = (value) => Math.round(u.valToPos(value, scale, true));
        const [mean, low, high] = this.columns[name];
        g.fillStyle = `${this.color(tint)}33`;
        const alone = [];
        for (let k = 0; k < t.length; k++) {
          if (low[k] === null) continue;
          const left = Math.round(u.valToPos(t[k] - width / 2, 'x', true));
          const wide = Math.max(1, Math.round(u.valToPos(t[k] + width / 2, 'x', true)) - left);
          const top = y(high[k]);
          g.fillRect(left, top, wide, Math.max(1, y(low[k]) - top));
          if ((mean[k - 1] ?? null) === null && (mean[k + 1] ?? null) === null) alone.push([left, y(mean[k]), wide]);
        }
        g.fillStyle = this.color(tint);
        for (const [left, top, wide] of alone) g.fillRect(left, top - ratio, Math.max(wide, 3 * ratio), 2 * ratio);
      }
      g.restore();
    };
  }

  // Ticks at the bottom of cells in which blocks had no estimate.
  unestimated() {
    return (u) => {
      const g = u.ctx;
      const ratio = window.devicePixelRatio || 1;
      g.save();
      g.fillStyle = this.color('--warn');
      for (const t of this.cells.times(this.cells.unestimated)) {
        const x = u.valToPos(t, 'x', true);
        if (x >= u.bbox.left && x <= u.bbox.left + u.bbox.width) g.fillRect(x - ratio, u.bbox.top + u.bbox.height - 6 * ratio, 2 * ratio, 6 * ratio);
      }
      g.restore();
    };
  }

  // What the cell under the cursor holds; without one, what the points are.
  tell(u) {
    const i = u.cursor.left >= 0 ? u.cursor.idx ?? null : null;
    const curves = [['ΔX', 'µm', 'dx'], ['ΔY', 'µm', 'dy'], ['θ', 'mdeg', 'theta']].map(([name, unit, key]) => [name, unit, ...this.columns[key]]);
    const text = this.cells.words(i, curves) || this.cells.about;
    const cell = document.getElementById('cell');
    if (cell.textContent !== text) cell.textContent = text;
  }

  resize() {
    for (const [name, plot] of Object.entries(this.plots)) {
      const element = this.elements[name];
      if (element.clientWidth > 0 && (plot.width !== element.clientWidth || plot.height !== element.clientHeight)) {
        plot.setSize({ width: element.clientWidth, height: element.clientHeight });
      }
    }
  }

  get width() {
    return this.elements.shift.clientWidth;
  }

  traces(rows, span) {
    const newest = rows.last('t');
    // What has just begun, and a recording that is short, fill the plot sooner.
    const held = newest - rows.last('t', rows.end - rows.start - 1);
    const shown = SOONER.find((s) => s < span && held < s) ?? span;
    this.state.to = newest;
    this.state.from = newest - shown;
    const first = Math.max(rows.from(newest - shown) - 1, rows.start);
    const [t, lost] = rows.slices(['t', 'lost'], first);
    this.state.losses = t.filter((_, i) => lost[i] > 0);
    const independent = this.references;
    this.state.references = independent.empty ? [[], [], [], []] : independent.slices(['t', 'dx', 'dy', 'theta'], independent.from(newest - shown));
    const of = (...names) => [t, ...rows.slices(names, first)];
    this.plots.shift.setData(of('dx', 'dx_low', 'dx_high', 'dy', 'dy_low', 'dy_high'));
    this.plots.theta.setData(of('theta', 'theta_low', 'theta_high'));
    this.plots.sums.setData(of(...this.sums));
  }

  // Shows what the daemon remembers in place of the last minute.
  history(cells) {
    const anew = this.cells === null;
    this.cells = cells;
    this.columns = Object.fromEntries([...Object.keys(SCALES), ...this.sums].map((name) => [name, ['', '_low', '_high'].map((end) => cells.column(name + end, SCALES[name] ?? 1))]));
    const { state, columns } = this;
    [state.from, state.to, state.marks, state.references] = [cells.from, cells.to, cells.marks, [[], [], [], []]];
    state.losses = cells.times(cells.lost);
    if (anew) this.build();
    this.plots.shift.setData([cells.t, ...columns.dx, ...columns.dy]);
    this.plots.theta.setData([cells.t, ...columns.theta]);
    this.plots.sums.setData([cells.t, ...this.sums.map((name) => columns[name][0])]);
    this.tell(this.plots.shift);
    document.body.dataset.cells = String(cells.t.length);
  }

  // Back to the last minute.
  live() {
    if (this.cells === null) return;
    [this.cells, this.columns, this.state.marks] = [null, null, this.marks];
    document.getElementById('cell').textContent = '';
    delete document.body.dataset.cells;
    this.build();
  }

  spectrum(density) {
    const channels = density || this.psds.flatMap((n) => [n, n]).map(() => this.frequencies.map(() => null));
    this.plots.spectrum.setData([this.frequencies, ...channels.map((c) => c.map((v) => (v > 0 ? v * 1e6 : null)))]);
  }
}

const sumColor = (n) => ['--dx', '--dy'][n - 1] ?? `--x${n}`;
