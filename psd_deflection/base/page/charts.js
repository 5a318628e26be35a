// Copyright 2026 psd_deflection maintainers
// SPDX-License-Identifier: Apache-2.0
// What the live page and the page of a recording draw alike, with uPlot (vendor/uPlot.LICENSE): axes, bands,
// marks, values under the cursor. Times are in s, on the plots in the units of the captions.

export function clock(seconds, digits = 0) {
  // Times of a CSV may count from its own zero.
  if (seconds < 1e9) return `${seconds.toFixed(digits)} s`;
  const ticks = Math.round(seconds * 10 ** digits);
  const text = new Date(Math.floor(ticks / 10 ** digits) * 1000).toLocaleTimeString([], { hour12: false });
  return digits ? `${text}.${String(ticks % 10 ** digits).padStart(digits, '0')}` : text;
}

// As many decimals as a step between ticks has: with fewer, a label would be of another time than its tick.
export function decimals(step) {
  for (let digits = 0; digits < 6; digits++) {
    const scaled = step * 10 ** digits;
    if (Math.abs(scaled - Math.round(scaled)) < 1e-6 * scaled) return digits;
  }
  return 6;
}

function times(u, ticks) {
  const digits = decimals(ticks.length > 1 ? ticks[1] - ticks[0] : 1);
  return ticks.map((t) => whole(u, t, digits));
}

// A label that the edge would cut is left out.
function whole(u, t, digits) {
  const room = u.bbox.width / (window.devicePixelRatio || 1) - u.valToPos(t, 'x');
  return room < 20 + 4 * digits ? '' : clock(t, digits);
}

export function number(value, digits = 5) {
  if (value === null || value === undefined) return '';
  return String(Number(value.toPrecision(digits))).replace('-', '\u2212');
}

// As many decimals as two digits of its standard deviation have; `low` and `high` are two of them off.
export function certain(value, low, high, digits) {
  const sd = (high - low) / 4;
  if (!(sd > 0)) return number(value, digits);
  return value.toFixed(Math.min(9, Math.max(0, 1 - Math.floor(Math.log10(sd))))).replace('-', '\u2212');
}

export function power(value) {
  if (value === null || value === undefined) return '';
  const digits = String(Math.round(Math.log10(value)));
  return '10' + [...digits].map((c) => (c === '-' ? '\u207b' : '\u2070\u00b9\u00b2\u00b3\u2074\u2075\u2076\u2077\u2078\u2079'[c])).join('');
}

// 1, 2, 5 of each decade if there are few, else decades; within one decade even steps.
export function logarithmic(u, axis, low, high) {
  const decades = Math.log10(high / low);
  const steps = decades > 3 ? [1] : [1, 2, 5];
  const found = [];
  for (let k = Math.floor(Math.log10(low)); k <= Math.log10(high); k++) {
    for (const step of steps) if (step * 10 ** k >= low * 0.999 && step * 10 ** k <= high * 1.001) found.push(step * 10 ** k);
  }
  if (found.length >= 3) return found;
  const step = 10 ** Math.floor(Math.log10((high - low) / 2));
  const even = [];
  for (let v = Math.ceil(low / step) * step; v <= high; v += step) even.push(v);
  return even;
}

// Far from 1 a power says more than its digits.
export function logarithms(u, ticks) {
  // uPlot leaves null for those that have no room.
  const far = ticks.some((v) => v !== null && (v > 1e4 || v < 1e-3));
  return ticks.map((v) => (far && Math.abs(Math.log10(v) % 1) < 1e-9 ? power(v) : number(v, 3)));
}

export function options(color, element, series, extra) {
  const axis = { stroke: color('--quiet'), grid: { stroke: color('--grid'), width: 1 }, ticks: { stroke: color('--grid'), width: 1, size: 4 }, font: '11px system-ui, sans-serif' };
  return {
    width: Math.max(100, element.clientWidth),
    height: Math.max(60, element.clientHeight),
    legend: { show: false },
    padding: [6, 8, 0, 0],
    series: [{}, ...series],
    ...extra,
    axes: [
      { ...axis, size: 26, space: 90, values: times, ...(extra.x || {}) },
      { ...axis, size: 62, space: 28, values: (u, ticks) => ticks.map((v) => number(v)), ...(extra.y || {}) },
    ],
  };
}

export const line = (color, width = 1.5) => ({ stroke: color, width, points: { show: false }, spanGaps: false });
export const edge = { stroke: 'transparent', width: 0, points: { show: false }, spanGaps: false };

// A range that a trace at rest does not fill with its noise, and that does not jump at every frame.
export function calm(least) {
  return (u, low, high) => {
    if (low === null || high === null) return [-least, least];
    const pad = Math.max(0.08 * (high - low), least / 2);
    const step = 10 ** Math.floor(Math.log10(high - low + 2 * pad)) / 4;
    return [Math.floor((low - pad) / step) * step, Math.ceil((high + pad) / step) * step];
  };
}

// A cursor that shows where it is; a stretch that is dragged over goes to `zoom`, a double click gives null.
export function cursor(zoom, sync) {
  return {
    y: false,
    points: { size: 6 },
    drag: { x: true, y: false, setScale: false },
    ...(sync ? { sync: { key: sync, setSeries: false } } : {}),
    bind: { dblclick: () => () => { zoom(null); return null; } },
  };
}

export function dragged(zoom) {
  return (u) => {
    if (u.select.width > 4) zoom([u.posToVal(u.select.left, 'x'), u.posToVal(u.select.left + u.select.width, 'x')]);
    if (u.select.width > 0) u.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
  };
}

// Red ticks at the top where samples are missing.
export function lossMarks(color, state) {
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

export function loadText(fx, fy, tz) {
  const parts = [[fx, 'N in X'], [fy, 'N in Y'], [tz, 'N\u00b7m']].filter(([value]) => value !== 0);
  return parts.length ? parts.map(([value, unit]) => `${number(value, 4)} ${unit}`).join(', ') : 'no load';
}

const LONGEST_WORDS = 40;
const short = (text) => (text.length > LONGEST_WORDS ? `${text.slice(0, LONGEST_WORDS - 1)}\u2026` : text);

// A dashed line where a load began or the zero was taken, a whole one at a mark or an alarm, with words where there is room.
export function eventMarks(color, state) {
  return (u) => {
    const g = u.ctx;
    const ratio = window.devicePixelRatio || 1;
    const right = u.bbox.left + u.bbox.width;
    // Marks have their words at the top, the others at the bottom.
    const free = { true: u.bbox.left, false: u.bbox.left };
    g.save();
    g.beginPath();
    g.rect(u.bbox.left, u.bbox.top, u.bbox.width, u.bbox.height);
    g.clip();
    g.lineWidth = ratio;
    g.textAlign = 'left';
    g.font = `${10 * ratio}px system-ui, sans-serif`;
    for (const [t, kind, ...load] of state.marks) {
      const x = Math.round(u.valToPos(t, 'x', true));
      if (x < u.bbox.left || x > right) continue;
      const marked = kind === 'mark' || kind === 'alarm';
      g.strokeStyle = g.fillStyle = color(kind === 'alarm' ? '--bad' : marked ? '--mark' : '--quiet');
      g.setLineDash(marked ? [] : [5 * ratio, 4 * ratio]);
      g.beginPath();
      g.moveTo(x, u.bbox.top);
      g.lineTo(x, u.bbox.top + u.bbox.height);
      g.stroke();
      const words = kind === 'load' ? loadText(...load) : marked ? short(load[0]) : kind;
      const wide = g.measureText(words).width + 8 * ratio;
      // To the left of the line where the edge would cut it.
      const from = x + wide > right ? x - wide : x;
      if (from < free[marked]) continue;
      g.fillText(words, from + 4 * ratio, u.bbox.top + (marked ? 20 * ratio : u.bbox.height - 5 * ratio));
      free[marked] = from + wide;
    }
    g.restore();
  };
}

const MOST_REFERENCES = 400;

// Small rings where an independent measurement was; `columns`: of t, and of each value its colour,
// the values and the series that it belongs to.
export function referenceMarks(color, columns) {
  return (u) => {
    const [ts, ...values] = columns();
    if (!ts.length) return;
    const g = u.ctx;
    const ratio = window.devicePixelRatio || 1;
    const step = Math.max(1, Math.ceil(ts.length / MOST_REFERENCES));
    g.save();
    g.beginPath();
    g.rect(u.bbox.left, u.bbox.top, u.bbox.width, u.bbox.height);
    g.clip();
    g.lineWidth = 1.2 * ratio;
    for (const [name, column, series] of values) {
      if (!u.series[series].show) continue;
      g.strokeStyle = color(name);
      for (let i = 0; i < ts.length; i += step) {
        if (column[i] === null) continue;
        g.beginPath();
        g.arc(u.valToPos(ts[i], 'x', true), u.valToPos(column[i], u.series[series].scale, true), 3 * ratio, 0, 2 * Math.PI);
        g.stroke();
      }
    }
    g.restore();
  };
}

export function modeMarks(color, modes, highest) {
  return (u) => {
    const g = u.ctx;
    const ratio = window.devicePixelRatio || 1;
    g.save();
    g.strokeStyle = color('--quiet');
    g.fillStyle = color('--quiet');
    g.setLineDash([3 * ratio, 3 * ratio]);
    g.font = `${10 * ratio}px system-ui, sans-serif`;
    const shown = modes.filter(([, hertz]) => hertz <= highest && hertz >= u.scales.x.min && hertz <= u.scales.x.max).sort((a, b) => a[1] - b[1]);
    shown.forEach(([name, hertz], i) => {
      const x = Math.round(u.valToPos(hertz, 'x', true));
      g.beginPath();
      g.moveTo(x, u.bbox.top);
      g.lineTo(x, u.bbox.top + u.bbox.height);
      g.stroke();
      const cut = x + 90 * ratio > u.bbox.left + u.bbox.width;
      const left = (i === 0 && x - 90 * ratio > u.bbox.left) || cut;
      g.textAlign = left ? 'right' : 'left';
      g.fillText(`${name} ${hertz} Hz`, x + (left ? -4 : 4) * ratio, u.bbox.top + (i > 0 && cut ? 23 : 11) * ratio);
    });
    g.restore();
  };
}

// The captions' keys: each shows its value under the cursor, and switches its curve on and off. A key names
// its plot and its series (data-plot, data-series); `hidden` remembers what is off when plots are built anew.
export class Legend {
  constructor(plotOf) {
    this.plotOf = plotOf;
    this.hidden = new Set();
    this.find();
  }

  find() {
    this.keys = [...document.querySelectorAll('button.key')];
    this.times = [...document.querySelectorAll('output.at')];
    for (const key of this.keys) key.onclick = () => this.toggle(key);
  }

  toggle(key) {
    const name = `${key.dataset.plot} ${key.dataset.series}`;
    const show = this.hidden.has(name);
    if (show) this.hidden.delete(name);
    else this.hidden.add(name);
    key.setAttribute('aria-pressed', String(show));
    this.apply(key.dataset.plot);
  }

  apply(name) {
    const plot = this.plotOf(name);
    for (const key of this.keys) {
      if (key.dataset.plot !== name) continue;
      const show = !this.hidden.has(`${name} ${key.dataset.series}`);
      // Its band has two series more.
      const last = Number(key.dataset.series) + ('band' in key.dataset ? 2 : 0);
      for (let i = Number(key.dataset.series); i <= last; i++) if (plot.series[i].show !== show) plot.setSeries(i, { show });
    }
  }

  follow(name, digits = 6) {
    return (u) => {
      const i = u.cursor.idx;
      const there = i !== null && i !== undefined && u.cursor.left >= 0;
      for (const key of this.keys) {
        if (key.dataset.plot !== name) continue;
        const series = Number(key.dataset.series);
        const at = u.cursor.idxs[series];
        const [value, low, high] = [0, 1, 2].map((k) => (there ? u.data[series + k]?.[at] ?? null : null));
        const banded = 'band' in key.dataset && low !== null && high !== null;
        write(key.querySelector('output'), value === null ? '' : banded ? certain(value, low, high, digits) : number(value, digits));
      }
      for (const at of this.times) {
        if (at.dataset.plot === name) write(at, there ? (at.dataset.unit ? `${number(u.data[0][i], 4)} ${at.dataset.unit}` : clock(u.data[0][i], 3)) : '');
      }
    };
  }
}

function write(element, text) {
  if (element.textContent !== text) element.textContent = text;
}
