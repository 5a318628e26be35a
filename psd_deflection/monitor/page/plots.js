// The traces, drawn by uPlot (vendor/uPlot.LICENSE).

const AXIS = 62;
const SOONER = [5, 10, 30];

function clock(seconds) {
  // Times of a CSV may count from its own zero.
  if (seconds < 1e9) return `${Math.round(seconds * 100) / 100} s`;
  const d = new Date(seconds * 1000);
  return d.toLocaleTimeString([], { hour12: false });
}

// A label that the edge would cut is left out.
function whole(u, t) {
  const room = u.bbox.width / (window.devicePixelRatio || 1) - u.valToPos(t, 'x');
  return room < 20 ? '' : clock(t);
}

function number(value) {
  if (value === null || value === undefined) return '';
  return String(Number(value.toPrecision(5))).replace('-', '\u2212');
}

function decades(u, axis, low, high) {
  const from = Math.ceil(Math.log10(low) - 1e-9);
  const to = Math.floor(Math.log10(high) + 1e-9);
  return Array.from({ length: Math.max(0, to - from + 1) }, (_, i) => 10 ** (from + i));
}

function power(value) {
  if (value === null || value === undefined) return '';
  const digits = String(Math.round(Math.log10(value)));
  return '10' + [...digits].map((c) => (c === '-' ? '\u207b' : '\u2070\u00b9\u00b2\u00b3\u2074\u2075\u2076\u2077\u2078\u2079'[c])).join('');
}

function options(color, element, series, extra) {
  const axis = { stroke: color('--quiet'), grid: { stroke: color('--grid'), width: 1 }, ticks: { stroke: color('--grid'), width: 1, size: 4 }, font: '11px system-ui, sans-serif' };
  return {
    width: Math.max(100, element.clientWidth),
    height: Math.max(60, element.clientHeight),
    legend: { show: false },
    cursor: { show: false },
    padding: [6, 8, 0, 0],
    series: [{}, ...series],
    ...extra,
    axes: [
      { ...axis, size: 26, space: 90, values: (u, ticks) => ticks.map((t) => whole(u, t)), ...(extra.x || {}) },
      { ...axis, size: AXIS, space: 28, values: (u, ticks) => ticks.map(number), ...(extra.y || {}) },
    ],
  };
}

// Red ticks at the top where samples are missing.
function lossMarks(color, state) {
  return (u) => {
    const g = u.ctx;
    g.save();
    g.fillStyle = color('--bad');
    const ratio = window.devicePixelRatio || 1;
    for (const t of state.losses) {
      const x = u.valToPos(t, 'x', true);
      if (x >= u.bbox.left && x <= u.bbox.left + u.bbox.width) g.fillRect(x - ratio, u.bbox.top, 2 * ratio, 8 * ratio);
    }
    g.restore();
  };
}

const line = (color, width = 1.5) => ({ stroke: color, width, points: { show: false }, spanGaps: false });
const edge = { stroke: 'transparent', width: 0, points: { show: false }, spanGaps: false };

// A range that a trace at rest does not fill with its noise, and that does not jump at every frame.
function calm(least) {
  return (u, low, high) => {
    if (low === null || high === null) return [-least, least];
    const pad = Math.max(0.08 * (high - low), least / 2);
    const step = 10 ** Math.floor(Math.log10(high - low + 2 * pad)) / 4;
    return [Math.floor((low - pad) / step) * step, Math.ceil((high + pad) / step) * step];
  };
}

export class Plots {
  constructor(hello, color) {
    this.state = { losses: [], from: 0, to: 1 };
    this.color = color;
    this.hello = hello;
    this.elements = Object.fromEntries(['shift', 'theta', 'sums', 'spectrum'].map((n) => [n, document.getElementById(`plot_${n}`)]));
    this.watch = new ResizeObserver(() => this.resize());
    this.build();
    for (const element of Object.values(this.elements)) this.watch.observe(element);
  }

  build() {
    const { color, elements, hello } = this;
    for (const plot of Object.values(this.plots || {})) plot.destroy();
    const fade = (name) => color(name) + '33';
    const time = { time: false, range: () => [this.state.from, this.state.to] };
    const hooks = { draw: [lossMarks(color, this.state)] };
    const [f0, bins] = hello.frequency;
    this.frequencies = Array.from({ length: bins }, (_, i) => f0 * (i + 1));
    this.plots = {
      shift: new uPlot(options(color, elements.shift, [line(color('--dx')), edge, edge, line(color('--dy')), edge, edge], {
        // uPlot fills from the upper edge down.
        bands: [{ series: [3, 2], fill: fade('--dx') }, { series: [6, 5], fill: fade('--dy') }],
        scales: { x: time, y: { range: calm(1) } }, hooks,
      }), this.empty(7), elements.shift),
      theta: new uPlot(options(color, elements.theta, [line(color('--theta')), edge, edge], {
        bands: [{ series: [3, 2], fill: fade('--theta') }],
        scales: { x: time, y: { range: calm(0.5) } }, hooks,
      }), this.empty(4), elements.theta),
      sums: new uPlot(options(color, elements.sums, [line(color('--dx')), line(color('--dy'))], {
        scales: { x: time, y: { range: () => [0, 1.5 * hello.sum_nominal] } },
      }), this.empty(3), elements.sums),
      spectrum: new uPlot(options(color, elements.spectrum, ['--x1', '--y1', '--x2', '--y2'].map((n) => line(color(n), 1)), {
        scales: { x: { time: false, distr: 3, range: [f0, f0 * bins] }, y: { distr: 3 } },
        hooks: { drawAxes: [this.modes()] },
        x: { splits: decades, values: (u, ticks) => ticks.map(number) },
        y: { splits: decades, values: (u, ticks) => ticks.map(power) },
      }), [this.frequencies, ...[1, 2, 3, 4].map(() => this.frequencies.map(() => null))], elements.spectrum),
    };
  }

  empty(n) {
    return Array.from({ length: n }, () => []);
  }

  modes() {
    return (u) => {
      const g = u.ctx;
      const ratio = window.devicePixelRatio || 1;
      g.save();
      g.strokeStyle = this.color('--quiet');
      g.fillStyle = this.color('--quiet');
      g.setLineDash([3 * ratio, 3 * ratio]);
      g.font = `${10 * ratio}px system-ui, sans-serif`;
      const shown = this.hello.modes.filter(([, hertz]) => hertz <= this.frequencies.at(-1)).sort((a, b) => a[1] - b[1]);
      shown.forEach(([name, hertz], i) => {
        const x = Math.round(u.valToPos(hertz, 'x', true));
        g.beginPath();
        g.moveTo(x, u.bbox.top);
        g.lineTo(x, u.bbox.top + u.bbox.height);
        g.stroke();
        const cut = x + 90 * ratio > u.bbox.left + u.bbox.width;
        const left = i === 0 || cut;
        g.textAlign = left ? 'right' : 'left';
        g.fillText(`${name} ${hertz} Hz`, x + (left ? -4 : 4) * ratio, u.bbox.top + (i > 0 && cut ? 23 : 11) * ratio);
      });
      g.restore();
    };
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
    const of = (...names) => [t, ...rows.slices(names, first)];
    this.plots.shift.setData(of('dx', 'dx_low', 'dx_high', 'dy', 'dy_low', 'dy_high'));
    this.plots.theta.setData(of('theta', 'theta_low', 'theta_high'));
    this.plots.sums.setData(of('sum1', 'sum2'));
  }

  spectrum(density) {
    const channels = density || [1, 2, 3, 4].map(() => this.frequencies.map(() => null));
    this.plots.spectrum.setData([this.frequencies, ...channels.map((c) => c.map((v) => (v > 0 ? v * 1e6 : null)))]);
  }
}
