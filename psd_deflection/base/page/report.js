// Copyright 2026 psd_deflection maintainers
// SPDX-License-Identifier: Apache-2.0
// The charts of a report: each figure of class chart has its declaration and its arrays as JSON inside
// (psd_deflection/base/charts.py). charts.js is put before this text.

import { cursor, dragged, edge, Legend, line, logarithmic, logarithms, number, options } from '/page/charts.js';

const styles = getComputedStyle(document.documentElement);
const color = (name) => styles.getPropertyValue(`--${name.replace(/^--/, '')}`).trim();
const CLOSE_PX = 12;

// Little-endian floats in base64 after the letter of their kind; NaN says that there is no value.
function column(text) {
  const bytes = Uint8Array.from(atob(text.slice(1)), (c) => c.charCodeAt(0));
  return Array.from(text[0] === 'd' ? new Float64Array(bytes.buffer) : new Float32Array(bytes.buffer), (v) => (Number.isNaN(v) ? null : v));
}

function make(tag, className, parent, text = '') {
  const made = document.createElement(tag);
  if (className) made.className = className;
  made.textContent = text;
  parent.append(made);
  return made;
}

const unitOf = (label) => (label.includes(' / ') ? label.split(' / ').at(-1).split(' ')[0] : '');

// As many digits as tell neighbouring labels apart.
function plain(u, ticks) {
  const step = ticks.length > 1 ? Math.abs(ticks[1] - ticks[0]) : 1;
  let digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-6));
  // 2.5 has one digit more than its size says.
  while (digits < 12 && Math.abs(Number(step.toFixed(digits)) - step) > 1e-3 * step) digits += 1;
  return ticks.map((v) => (Math.abs(v) >= 1e6 || digits > 6 ? number(v, 6) : v.toFixed(digits).replace('-', '\u2212')));
}

// Curves over one axis, ascending; what a curve does not have at an x is undefined, which is no gap, unlike null.
function aligned(panel, columns) {
  const groups = [...new Set(panel.series.map((one) => one.x))];
  const rows = [];
  for (const x of groups) columns[x].forEach((value, i) => { if (value !== null && !(panel.log.includes('x') && value <= 0)) rows.push([value, x, i]); });
  rows.sort((a, b) => a[0] - b[0]);
  const data = [rows.map((row) => row[0])];
  const take = (one, of) => rows.map(([, x, i]) => {
    if (x !== one.x) return undefined;
    const value = of(i);
    return value === null || (panel.log.includes('y') && value <= 0) ? null : value;
  });
  for (const one of panel.series) {
    const y = columns[one.y];
    data.push(take(one, (i) => y[i]));
    if (one.spread === null) continue;
    for (const sign of [-1, 1]) data.push(take(one, (i) => (y[i] === null ? null : y[i] + sign * columns[one.spread][i])));
  }
  return data;
}

function extent(...arrays) {
  let [low, high] = [Infinity, -Infinity];
  for (const values of arrays) {
    for (const v of values) {
      if (v === null || v === undefined) continue;
      if (v < low) low = v;
      if (v > high) high = v;
    }
  }
  return low > high ? [0, 1] : low === high ? [low - (Math.abs(low) || 1), high + (Math.abs(high) || 1)] : [low, high];
}

function padded([low, high], log, share) {
  if (log && !(low > 0)) return [high / 10, high];
  if (log) return [low * (high / low) ** -share, high * (high / low) ** share];
  return [low - share * (high - low), high + share * (high - low)];
}

// Of the points near the cursor the one that is nearest to it.
function nearest(u, series, at) {
  if (at === null || u.cursor.left < 0) return null;
  const [xs, ys] = [u.data[0], u.data[series]];
  let [found, least] = [null, CLOSE_PX ** 2 * 25];
  const look = (i) => {
    const dx = u.valToPos(xs[i], 'x') - u.cursor.left;
    if (Math.abs(dx) > CLOSE_PX) return false;
    if (ys[i] !== null && ys[i] !== undefined) {
      const distance = (5 * dx) ** 2 + (u.valToPos(ys[i], 'y') - u.cursor.top) ** 2;
      if (distance < least) [found, least] = [i, distance];
    }
    return true;
  };
  for (let i = at; i < xs.length && look(i); i++);
  for (let i = at - 1; i >= 0 && look(i); i--);
  return found;
}

// A finger that moves across does what a mouse does; one that moves up or down scrolls the page.
function touched(over) {
  const as = { pointerdown: 'mousedown', pointermove: 'mousemove', pointerup: 'mouseup', pointercancel: 'mouseup' };
  for (const [name, mouse] of Object.entries(as)) {
    over.addEventListener(name, (event) => {
      if (event.pointerType !== 'touch') return;
      // uPlot takes a move of nothing for none.
      const { clientX, clientY } = event;
      over.dispatchEvent(new MouseEvent(mouse, { clientX, clientY, movementX: 1, bubbles: true }));
    });
  }
}

function ruled(rules) {
  return (u) => {
    const g = u.ctx;
    const ratio = window.devicePixelRatio || 1;
    const { left, top, width, height } = u.bbox;
    g.save();
    g.beginPath();
    g.rect(left, top, width, height);
    g.clip();
    g.font = `${11 * ratio}px system-ui, sans-serif`;
    g.lineWidth = ratio;
    g.textAlign = 'left';
    g.textBaseline = 'alphabetic';
    g.setLineDash([5 * ratio, 4 * ratio]);
    let row = 0;
    for (const [at, words, across, name] of rules) {
      const place = Math.round(u.valToPos(at, across ? 'y' : 'x', true));
      g.strokeStyle = g.fillStyle = color(name);
      g.beginPath();
      g.moveTo(across ? left : place, across ? place : top);
      g.lineTo(across ? left + width : place, across ? place : top + height);
      g.stroke();
      if (!words || (!across && (place < left || place > left + width))) continue;
      const wide = g.measureText(words).width;
      // Below the line where the edge would cut the words.
      if (across) g.fillText(words, left + width - wide - 4 * ratio, place + (place - 16 * ratio < top ? 13 : -4) * ratio);
      else g.fillText(words, place + wide + 8 * ratio > left + width ? place - wide - 4 * ratio : place + 4 * ratio, top + (12 + 13 * (row++ % 3)) * ratio);
    }
    g.restore();
  };
}

// ± of points as upright bars.
function barred(bars) {
  return (u) => {
    const g = u.ctx;
    const ratio = window.devicePixelRatio || 1;
    g.save();
    g.lineWidth = 1.5 * ratio;
    for (const [index, name] of bars) {
      if (!u.series[index].show) continue;
      g.strokeStyle = color(name);
      for (let i = 0; i < u.data[0].length; i++) {
        const [low, high] = [u.data[index + 1][i], u.data[index + 2][i]];
        if (low === null || low === undefined || u.data[0][i] < u.scales.x.min || u.data[0][i] > u.scales.x.max) continue;
        const x = u.valToPos(u.data[0][i], 'x', true);
        g.beginPath();
        g.moveTo(x, u.valToPos(low, 'y', true));
        g.lineTo(x, u.valToPos(high, 'y', true));
        g.stroke();
      }
    }
    g.restore();
  };
}

function curve(one) {
  const tone = color(one.colour);
  if (one.style === 'line') return { ...line(tone, one.bold ? 2.6 : 1.3), points: { size: 4, fill: tone, stroke: tone, width: 0 } };
  const ring = one.style === 'rings';
  const points = { show: true, size: ring ? 6 : 4, fill: ring ? 'transparent' : tone, stroke: tone, width: ring ? 1.2 : 0 };
  return { stroke: tone, paths: () => null, points };
}

class Panel {
  constructor(chart, panel, columns, name, label, below) {
    Object.assign(this, { chart, panel, name, below });
    this.data = aligned(panel, columns);
    this.cloud = panel.series.every((one) => one.style !== 'line') && this.data[0].some((x, i, xs) => x === xs[i - 1]);
    const room = make('div', chart.beside > 1 ? 'panel small' : 'panel', chart.room);
    const head = make('div', 'head', room);
    make('span', 'label', head, panel.y);
    this.first = [];
    let index = 1;
    for (const one of panel.series) {
      this.first.push(index);
      if (one.name) {
        const key = make('button', `key ${one.style}`, head);
        key.style.setProperty('--tone', `var(--${one.colour})`);
        key.type = 'button';
        Object.assign(key.dataset, { plot: name, series: index, name: one.name });
        if (one.spread !== null) key.dataset.band = '';
        key.setAttribute('aria-pressed', 'true');
        key.append(`${one.name} `);
        make('output', '', key);
      }
      index += one.spread === null ? 1 : 3;
    }
    Object.assign(make('output', 'at quiet', head).dataset, { plot: name, unit: unitOf(panel.x) });
    this.element = make('div', 'plot', room);
    Object.assign(this.element, { id: `plot_${name}`, tabIndex: 0 });
    this.element.style.height = `${panel.height}px`;
    this.element.setAttribute('role', 'group');
    this.element.setAttribute('aria-label', `${label}: ${panel.y} over ${panel.x}; the arrow keys move the cursor, + and \u2212 zoom, 0 shows all`);
    this.element.onkeydown = (event) => this.key(event);
    this.element.onblur = () => this.plot?.setCursor({ left: -10, top: -10 }, true, true);
    if (!below) make('div', 'along quiet', room, panel.x);
    new ResizeObserver(() => this.fit()).observe(this.element);
  }

  fit() {
    const width = this.element.clientWidth;
    if (width > 0 && !this.plot) this.build();
    else if (width > 0 && width !== this.plot.width) this.plot.setSize({ width, height: this.element.clientHeight });
  }

  // The whole of y, also of the panels beside it that have the same.
  heights() {
    const alike = this.chart.panels.filter((other) => other.panel.y === this.panel.y);
    const levels = this.panel.rules.filter((rule) => rule[2]).map((rule) => rule[0]);
    return padded(extent(levels, ...alike.flatMap((other) => other.data.slice(1))), this.panel.log.includes('y'), 0.06);
  }

  build() {
    const { panel, chart, data, element } = this;
    const series = [];
    const bands = [];
    const bars = [];
    panel.series.forEach((one, i) => {
      series.push(curve(one));
      if (one.spread === null) return;
      series.push(edge, edge);
      // uPlot fills from the upper edge down.
      if (one.style === 'line') bands.push({ series: [this.first[i] + 2, this.first[i] + 1], fill: `${color(one.colour)}33` });
      else bars.push([this.first[i], one.colour]);
    });
    const [logX, logY] = ['x', 'y'].map((letter) => panel.log.includes(letter));
    const all = this.heights();
    const zoom = (range) => chart.zoom(panel.x, range);
    const axis = (log) => (log ? { splits: logarithmic, values: logarithms } : { values: plain });
    const moved = cursor(zoom, `${chart.name} ${panel.x}`);
    if (this.cloud) moved.dataIdx = (u, i, at) => (i ? nearest(u, i, at) : at);
    const scales = {
      x: { time: false, distr: logX ? 3 : 1, range: () => chart.ranges.get(panel.x) ?? chart.whole(panel.x) },
      y: {
        distr: logY ? 3 : 1,
        range: (u, low, high) => (chart.ranges.get(panel.x) ? padded(extent([low, high]), logY, 0.08) : panel.range ?? all),
      },
    };
    this.plot = new uPlot(options(color, element, series, {
      bands,
      scales,
      // The last label of x is half outside.
      padding: [6, 18, 0, 0],
      cursor: moved,
      hooks: { draw: [barred(bars), ruled(panel.rules)], setCursor: [legend.follow(this.name, chart.beside > 1 ? 4 : 6)], setSelect: [dragged(zoom)] },
      x: this.below ? { size: 8, values: (u, ticks) => ticks.map(() => '') } : { space: 60, ...axis(logX) },
      y: { size: 54, ...axis(logY) },
    }), data, element);
    touched(this.plot.over);
    legend.apply(this.name);
  }

  key(event) {
    const steps = { ArrowLeft: -1, ArrowRight: 1, PageUp: -20, PageDown: 20 };
    if (event.ctrlKey || event.metaKey || event.altKey || !this.plot) return;
    const [low, high] = this.chart.ranges.get(this.panel.x) ?? this.chart.whole(this.panel.x);
    const at = this.plot.cursor.left >= 0 ? this.plot.posToVal(this.plot.cursor.left, 'x') : (low + high) / 2;
    if (event.key in steps) this.step(steps[event.key], at, low, high);
    else if (event.key === '+' || event.key === '-') {
      const share = event.key === '+' ? 0.5 : 2;
      this.chart.zoom(this.panel.x, [at - (at - low) * share, at + (high - at) * share]);
    } else if (event.key === '0' || event.key === 'Escape') this.chart.zoom(this.panel.x, null);
    else return;
    event.preventDefault();
  }

  // To the next x that the plot has.
  step(by, at, low, high) {
    const xs = this.data[0];
    if (!xs.length) return;
    const sign = Math.sign(by);
    let i = this.plot.valToIdx(at);
    for (let n = this.plot.cursor.left < 0 ? 0 : Math.abs(by); n > 0; n--) {
      const from = xs[i];
      while (xs[i] === from && xs[i + sign] !== undefined) i += sign;
    }
    const there = Math.min(high, Math.max(low, xs[i]));
    this.plot.setCursor({ left: this.plot.valToPos(there, 'x'), top: this.element.clientHeight / 3 }, true, true);
  }
}

class Chart {
  constructor(figure, number) {
    const told = JSON.parse(figure.querySelector('script').textContent);
    const columns = told.columns.map(column);
    this.name = `c${number}`;
    this.beside = told.beside;
    this.ranges = new Map();
    const caption = make('figcaption', '', figure);
    make('span', '', caption, told.words);
    if (told.note) make('span', 'quiet', caption, told.note);
    this.back = make('button', 'whole', caption, 'All of it');
    this.back.type = 'button';
    this.back.onclick = () => { for (const x of this.ranges.keys()) this.zoom(x, null); };
    this.room = make('div', 'panels', figure);
    this.room.style.setProperty('--beside', told.beside);
    this.panels = [];
    told.panels.forEach((panel, i) => {
      const below = told.beside === 1 && told.panels[i + 1]?.x === panel.x;
      this.panels.push(new Panel(this, panel, columns, `${this.name}p${i}`, told.words, below));
    });
    this.extents = new Map();
  }

  // All of an axis, for the panels that share it.
  whole(x) {
    if (!this.extents.has(x)) {
      const alike = this.panels.filter((one) => one.panel.x === x);
      const upright = alike.flatMap((one) => one.panel.rules.filter((rule) => !rule[2]).map((rule) => rule[0]));
      const share = alike.some((one) => one.panel.series.some((curve) => curve.style !== 'line')) ? 0.02 : 0;
      this.extents.set(x, padded(extent(upright, ...alike.map((one) => one.data[0])), alike[0].panel.log.includes('x'), share));
    }
    return this.extents.get(x);
  }

  zoom(x, range) {
    const [low, high] = this.whole(x);
    const inside = range && [Math.max(low, range[0]), Math.min(high, range[1])];
    this.ranges.set(x, inside && inside[1] > inside[0] && (inside[0] > low || inside[1] < high) ? inside : null);
    for (const one of this.panels) if (one.panel.x === x) one.plot?.setData(one.data);
    this.back.classList.toggle('zoomed', [...this.ranges.values()].some((one) => one));
  }
}

let charts = [];
const panels = () => charts.flatMap((chart) => chart.panels);
charts = [...document.querySelectorAll('figure.chart')].map((figure, number) => new Chart(figure, number));
// A plot that lies in closed details is not there yet; it asks when it is built.
const absent = { series: Array(100).fill({ show: null }), setSeries() {} };
const legend = new Legend((name) => panels().find((one) => one.name === name).plot ?? absent);
// Curves of one name are one thing in all panels of a chart.
for (const key of legend.keys) {
  key.onclick = () => {
    for (const other of key.closest('figure').querySelectorAll('button.key')) if (other.dataset.name === key.dataset.name) legend.toggle(other);
  };
}
if (charts.length) make('span', 'quiet', document.querySelector('figure.chart figcaption'), 'Drag over a plot to look closer; a double click shows all of it.');
matchMedia('(prefers-color-scheme: dark)').onchange = () => {
  for (const one of panels()) {
    one.plot?.destroy();
    one.plot = null;
    one.fit();
  }
};
