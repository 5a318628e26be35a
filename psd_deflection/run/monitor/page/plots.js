// The live traces and the spectrum.

import { calm, cursor, decades, dragged, edge, eventMarks, Legend, line, lossMarks, modeMarks, number, options, power, referenceMarks } from '/page/charts.js';

const SOONER = [5, 10, 30];

export class Plots {
  // `zoomed` is called when a stretch of the traces is chosen (true), or left by a double click (false).
  constructor(hello, color, references, zoomed) {
    this.state = { losses: [], marks: [], references: [[], [], [], []], from: 0, to: 1 };
    this.color = color;
    this.hello = hello;
    this.references = references;
    this.band = null;
    this.zoom = (range) => {
      if (range) [this.state.from, this.state.to] = range;
      zoomed(range !== null);
      if (range) for (const name of ['shift', 'theta', 'sums']) this.plots[name].setData(this.plots[name].data);
    };
    this.elements = Object.fromEntries(['shift', 'theta', 'sums', 'spectrum'].map((n) => [n, document.getElementById(`plot_${n}`)]));
    this.legend = new Legend((name) => this.plots[name]);
    this.watch = new ResizeObserver(() => this.resize());
    this.build();
    for (const element of Object.values(this.elements)) this.watch.observe(element);
  }

  build() {
    const { color, elements, hello, legend } = this;
    legend.find();
    this.psds = hello.active_areas.map((_, i) => i + 1);
    this.sums = this.psds.map((n) => `sum${n}`);
    const dots = this.psds.flatMap((n) => [`--x${n}`, `--y${n}`]);
    for (const plot of Object.values(this.plots || {})) plot.destroy();
    const fade = (name) => color(name) + '33';
    const time = { time: false, range: () => [this.state.from, this.state.to] };
    const seen = (name, draw) => ({ draw, setCursor: [legend.follow(name)], setSelect: [dragged(this.zoom)] });
    const marked = [lossMarks(color, this.state), eventMarks(color, this.state)];
    const of = (...columns) => referenceMarks(color, () => [this.state.references[0], ...columns.map(([name, i, series]) => [name, this.state.references[i], series])]);
    const [f0, bins] = hello.frequency;
    this.frequencies = Array.from({ length: bins }, (_, i) => f0 * (i + 1));
    const spectral = (range) => {
      this.band = range;
      this.plots.spectrum.setData(this.plots.spectrum.data);
    };
    this.plots = {
      shift: new uPlot(options(color, elements.shift, [line(color('--dx')), edge, edge, line(color('--dy')), edge, edge], {
        // uPlot fills from the upper edge down.
        bands: [{ series: [3, 2], fill: fade('--dx') }, { series: [6, 5], fill: fade('--dy') }],
        scales: { x: time, y: { range: calm(1) } },
        cursor: cursor(this.zoom, 'traces'),
        hooks: seen('shift', [...marked, of(['--dx', 1, 1], ['--dy', 2, 4])]),
      }), this.empty(7), elements.shift),
      theta: new uPlot(options(color, elements.theta, [line(color('--theta')), edge, edge], {
        bands: [{ series: [3, 2], fill: fade('--theta') }],
        scales: { x: time, y: { range: calm(0.5) } },
        cursor: cursor(this.zoom, 'traces'),
        hooks: seen('theta', [...marked, of(['--theta', 3, 1])]),
      }), this.empty(4), elements.theta),
      sums: new uPlot(options(color, elements.sums, this.psds.map((n) => line(color(['--dx', '--dy'][n - 1] ?? `--x${n}`))), {
        scales: { x: time, y: { range: () => [0, 1.5 * hello.sum_nominal] } },
        cursor: cursor(this.zoom, 'traces'),
        hooks: seen('sums', [eventMarks(color, this.state)]),
      }), this.empty(1 + this.psds.length), elements.sums),
      spectrum: new uPlot(options(color, elements.spectrum, dots.map((n) => line(color(n), 1)), {
        scales: { x: { time: false, distr: 3, range: () => this.band ?? [f0, f0 * bins] }, y: { distr: 3 } },
        cursor: cursor(spectral),
        hooks: { drawAxes: [modeMarks(color, hello.modes, this.frequencies.at(-1))], setCursor: [legend.follow('spectrum', 3)], setSelect: [dragged(spectral)] },
        x: { splits: decades, values: (u, ticks) => ticks.map((v) => number(v)) },
        y: { splits: decades, values: (u, ticks) => ticks.map(power) },
      }), [this.frequencies, ...dots.map(() => this.frequencies.map(() => null))], elements.spectrum),
    };
    for (const name of Object.keys(this.plots)) legend.apply(name);
  }

  empty(n) {
    return Array.from({ length: n }, () => []);
  }

  resize() {
    for (const [name, plot] of Object.entries(this.plots)) {
      const element = this.elements[name];
      if (element.clientWidth > 0 && (plot.width !== element.clientWidth || plot.height !== element.clientHeight)) {
        plot.setSize({ width: element.clientWidth, height: element.clientHeight });
      }
    }
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

  spectrum(density) {
    const channels = density || this.psds.flatMap((n) => [n, n]).map(() => this.frequencies.map(() => null));
    this.plots.spectrum.setData([this.frequencies, ...channels.map((c) => c.map((v) => (v > 0 ? v * 1e6 : null)))]);
  }
}
