// Copyright 2026 psd_deflection maintainers
// SPDX-License-Identifier: Apache-2.0
// The page of a recording (`psd-deflection plot --out X.html`): the whole of it, drawn once, in a file that
// needs no server. The plot command puts charts.js before this text.

import { calm, clock, cursor, dragged, edge, eventMarks, Legend, line, logarithmic, logarithms, lossMarks, modeMarks, options, referenceMarks } from '/page/charts.js';

const read = JSON.parse(document.getElementById('recording').textContent);
const styles = getComputedStyle(document.documentElement);
const color = (name) => styles.getPropertyValue(name).trim();
const fade = (name) => color(name) + '33';
const MICRO = 1e6;
const MDEG = (180 / Math.PI) * 1e3;

// Columns are little-endian floats in base64; NaN says that there is no value.
function column(text, scale = 1, Kind = Float32Array) {
  const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  return Array.from(new Kind(bytes.buffer), (v) => (Number.isNaN(v) ? null : v * scale));
}

const t = column(read.columns.t, 1, Float64Array);
const lost = column(read.columns.lost);
const state = {
  losses: t.filter((_, i) => lost[i] !== 0),
  marks: read.marks,
  from: t[0],
  to: t.at(-1) > t[0] ? t.at(-1) : t[0] + 1,
};
const all = [state.from, state.to];
const references = {};
for (const [name, scale] of [['dx', MICRO], ['dy', MICRO], ['theta', MDEG]]) references[name] = column(read.references[name], scale);
const referenceTimes = column(read.references.t, 1, Float64Array);
for (const key of document.querySelectorAll('.references')) key.hidden = !referenceTimes.length;

function band(name, scale) {
  const value = column(read.columns[name], scale);
  const sd = column(read.columns[`sd_${name}`], scale);
  const off = (k) => value.map((v, i) => (v === null || sd[i] === null ? null : v + k * sd[i]));
  return [value, off(-2), off(2)];
}

let plots = {};
const psds = read.active_areas.map((_, i) => i + 1);
const element = (name) => document.getElementById(`plot_${name}`);
const legend = new Legend((name) => plots[name]);
const timed = () => Object.entries(plots).filter(([name]) => name !== 'spectrum').map(([, plot]) => plot);

function zoom(range) {
  [state.from, state.to] = range ?? all;
  for (const plot of timed()) plot.setData(plot.data);
  drawDots();
  document.getElementById('whole').setAttribute('aria-disabled', String(range === null));
}

const time = { time: false, range: () => [state.from, state.to] };
const seen = (name, draw) => ({ draw, setCursor: [legend.follow(name)], setSelect: [dragged(zoom)] });
const of = (...names) => referenceMarks(color, () => [referenceTimes, ...names.map(([name, key, series]) => [name, references[key], series])]);
const data = {
  shift: [t, ...band('dx', MICRO), ...band('dy', MICRO)],
  theta: [t, ...band('theta', MDEG)],
  sums: [t, ...psds.map((n) => column(read.columns[`sum${n}`]))],
};
if (read.loads.t) data.load = [column(read.loads.t, 1, Float64Array), ...['fx', 'fy', 'tz'].map((name) => column(read.loads[name]))];
if (read.spectrum) data.spectrum = [column(read.spectrum.f), ...read.spectrum.density.map((text) => column(text, MICRO).map((v) => (v > 0 ? v : null)))];
const limits = { frequencies: null };

function spectral(range) {
  limits.frequencies = range;
  plots.spectrum.setData(plots.spectrum.data);
}

function build() {
  for (const plot of Object.values(plots)) plot.destroy();
  plots = {};
  const marked = [lossMarks(color, state), eventMarks(color, state)];
  const steps = uPlot.paths.stepped({ align: 1 });
  const made = {
    shift: () => options(color, element('shift'), [line(color('--dx')), edge, edge, line(color('--dy')), edge, edge], {
      bands: [{ series: [3, 2], fill: fade('--dx') }, { series: [6, 5], fill: fade('--dy') }],
      scales: { x: time, y: { range: calm(1) } }, cursor: cursor(zoom, 'traces'), hooks: seen('shift', [...marked, of(['--dx', 'dx', 1], ['--dy', 'dy', 4])]),
    }),
    theta: () => options(color, element('theta'), [line(color('--theta')), edge, edge], {
      bands: [{ series: [3, 2], fill: fade('--theta') }],
      scales: { x: time, y: { range: calm(0.5) } }, cursor: cursor(zoom, 'traces'), hooks: seen('theta', [...marked, of(['--theta', 'theta', 1])]),
    }),
    load: () => options(color, element('load'), ['--dx', '--dy', '--theta'].map((name) => ({ ...line(color(name)), paths: steps })), {
      scales: { x: time, y: { range: calm(1) } }, cursor: cursor(zoom, 'traces'), hooks: seen('load', [eventMarks(color, state)]),
    }),
    sums: () => options(color, element('sums'), psds.map((n) => line(color(['--dx', '--dy'][n - 1] ?? `--x${n}`))), {
      scales: { x: time, y: { range: () => [0, 1.5 * read.sum_nominal] } }, cursor: cursor(zoom, 'traces'), hooks: seen('sums', [eventMarks(color, state)]),
    }),
    spectrum: () => options(color, element('spectrum'), psds.flatMap((n) => [`--x${n}`, `--y${n}`]).map((name) => line(color(name), 1)), {
      scales: { x: { time: false, distr: 3, range: () => limits.frequencies ?? [data.spectrum[0][0], data.spectrum[0].at(-1)] }, y: { distr: 3 } },
      cursor: cursor(spectral),
      hooks: { drawAxes: [modeMarks(color, read.modes, data.spectrum[0].at(-1))], setCursor: [legend.follow('spectrum', 3)], setSelect: [dragged(spectral)] },
      x: { splits: logarithmic, values: logarithms },
      y: { splits: logarithmic, values: logarithms },
    }),
  };
  for (const name of Object.keys(data)) plots[name] = new uPlot(made[name](), data[name], element(name));
  for (const name of Object.keys(plots)) legend.apply(name);
  drawDots();
}

const dots = psds.map((psd) => ['x', 'y'].map((axis) => column(read.columns[`${axis}${psd}`])));

// The dots of the time that is shown, on the active areas.
function drawDots() {
  for (const [k, canvas] of [...document.querySelectorAll('.detector canvas')].entries()) {
    const [width, height] = read.active_areas[k];
    const ratio = window.devicePixelRatio || 1;
    canvas.style.aspectRatio = `${width} / ${height}`;
    canvas.width = Math.round(canvas.clientWidth * ratio);
    canvas.height = Math.round(canvas.clientHeight * ratio);
    const scale = 0.94 * Math.min(canvas.width / width, canvas.height / height);
    const g = canvas.getContext('2d');
    g.fillStyle = color('--plate');
    g.fillRect(canvas.width / 2 - (width / 2) * scale, canvas.height / 2 - (height / 2) * scale, width * scale, height * scale);
    g.strokeStyle = color('--quiet');
    g.strokeRect(canvas.width / 2 - (width / 2) * scale, canvas.height / 2 - (height / 2) * scale, width * scale, height * scale);
    g.fillStyle = color('--laser');
    g.globalAlpha = 0.5;
    const [x, y] = dots[k];
    for (let i = 0; i < t.length; i++) {
      if (t[i] < state.from || t[i] > state.to || x[i] === null || y[i] === null) continue;
      g.fillRect(canvas.width / 2 + x[i] * scale - ratio, canvas.height / 2 - y[i] * scale - ratio, 2 * ratio, 2 * ratio);
    }
  }
}

build();
new ResizeObserver(() => {
  for (const [name, plot] of Object.entries(plots)) {
    const room = element(name);
    if (room.clientWidth > 0 && plot.width !== room.clientWidth) plot.setSize({ width: room.clientWidth, height: room.clientHeight });
  }
  drawDots();
}).observe(document.querySelector('main'));
matchMedia('(prefers-color-scheme: dark)').onchange = build;
document.getElementById('whole').onclick = () => zoom(null);
document.getElementById('range').textContent = `${clock(t[0], 1)} to ${clock(t.at(-1), 1)} of the recording`;
