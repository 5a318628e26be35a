// Copyright 2026 psd_deflection maintainers
// SPDX-License-Identifier: Apache-2.0
// The last hours and days: cells of the daemon's history, asked for while they are looked at. One answer is kept.

import { clock, number } from '/page/charts.js';

const LONGEST_PERIOD_S = 10;
const [LEAST_POINTS, MOST_POINTS] = [100, 2000];
const DAY_S = 86400;

// One answer. A column is an array in which null is a cell without a value.
export class Cells {
  constructor(content, from, to) {
    this.from = from;
    this.to = to;
    this.width = content.width;
    this.marks = content.marks;
    this.packed = content.columns;
    const lost = this.column('lost');
    const length = lost.length;
    this.t = Array.from({ length }, (_, i) => content.start + (i + 0.5) * content.width);
    this.lost = lost;
    this.blocks = this.column('blocks');
    this.unestimated = this.column('estimates').map((there, i) => this.blocks[i] - there);
  }

  // Columns are little-endian floats in base64; NaN says that there is no value.
  column(name, scale = 1) {
    const bytes = Uint8Array.from(atob(this.packed[name]), (c) => c.charCodeAt(0));
    return Array.from(new Float32Array(bytes.buffer), (v) => (Number.isNaN(v) ? null : v * scale));
  }

  // Where a count is not zero.
  times(counts) {
    return this.t.filter((_, i) => counts[i] > 0);
  }

  // The cell `i` in words; `values`: name, unit, mean, least and greatest of each curve.
  words(i, values) {
    if (i === null || !this.blocks[i]) return '';
    const parts = values.filter(([, , mean]) => mean[i] !== null).map(([name, unit, mean, low, high]) => (
      `${name} ${number(mean[i])} (${number(low[i])} to ${number(high[i])}) ${unit}`));
    if (this.lost[i]) parts.push(`${this.lost[i]} samples lost`);
    if (this.unestimated[i]) parts.push(`${this.unestimated[i]} of ${this.blocks[i]} blocks without an estimate`);
    return `${day(this.t[i])}${clock(this.t[i] - this.width / 2)} + ${length(this.width)}: ${parts.join(', ')}`;
  }

  get about() {
    return `a point is the mean of ${length(this.width)}, the band goes from its least to its greatest value`;
  }
}

function length(seconds) {
  if (seconds % 3600 === 0) return `${seconds / 3600} h`;
  return seconds % 60 === 0 ? `${seconds / 60} min` : `${seconds} s`;
}

function day(t) {
  return t < 1e9 ? '' : `${new Date(t * 1000).toLocaleDateString([], { weekday: 'short', day: 'numeric', month: 'short' })} `;
}

// Times of day at whole minutes, hours and days of this place.
const STEPS = [1, 2, 5, 10, 20, 30, 60, 120, 300, 600, 1200, 1800, 3600, 7200, 10800, 21600, 43200, DAY_S, 2 * DAY_S];

export const hours = {
  incrs: STEPS,
  splits: (u, axis, low, high, step) => {
    const off = low < 1e9 ? 0 : -60 * new Date(low * 1000).getTimezoneOffset();
    const first = Math.ceil((low + off) / step) * step - off;
    return Array.from({ length: Math.max(0, Math.floor((high - first) / step) + 1) }, (_, i) => first + i * step);
  },
  values: (u, ticks) => {
    const step = ticks.length > 1 ? ticks[1] - ticks[0] : 1;
    const right = u.scales.x.max - 0.03 * (u.scales.x.max - u.scales.x.min);
    return ticks.map((t) => {
      if (t > right) return '';
      if (t < 1e9) return clock(t);
      const date = new Date(t * 1000);
      if (step >= DAY_S || (date.getHours() === 0 && date.getMinutes() === 0 && date.getSeconds() === 0)) return day(t).trim();
      return date.toLocaleTimeString([], { hour12: false, hour: '2-digit', minute: '2-digit', ...(step < 60 ? { second: '2-digit' } : {}) });
    });
  },
};

// What is looked at: the last `span` s, or a `range` of times that was dragged over; 0: nothing.
export class History {
  // `show` gets Cells; `fail` why there are none.
  constructor(show, fail) {
    this.show = show;
    this.fail = fail;
    this.span = 0;
    this.range = null;
    this.renew();
  }

  look(span) {
    this.span = span;
    this.zoom(null);
  }

  zoom(range) {
    this.range = range;
    this.renew();
  }

  // What is on its way is of another window, or of other data.
  renew() {
    this.turn = (this.turn ?? 0) + 1;
    this.busy = false;
    this.due = 0;
  }

  // Once a frame. `newest`: time of the newest row. `width`: of the plot, px.
  tick(now, newest, held, width) {
    if (!this.span || this.busy || newest === null || now < this.due) return;
    if (held && !this.range) return;
    const [from, to] = this.range ?? [newest - this.span, newest];
    this.load(from, to, Math.round(Math.min(MOST_POINTS, Math.max(LEAST_POINTS, width))));
  }

  async load(from, to, points) {
    const { turn } = this;
    this.busy = true;
    let period = 1;
    try {
      const answer = await fetch(`/api/history?from=${from}&to=${to}&points=${points}`);
      const content = await answer.json();
      if (turn !== this.turn) return;
      if (answer.ok) {
        const cells = new Cells(content, from, to);
        this.show(cells);
        period = this.range ? Infinity : Math.min(LONGEST_PERIOD_S, cells.width);
      } else this.fail(content.message);
    } catch {
      // The connection is lost; the state says so.
    }
    if (turn !== this.turn) return;
    this.busy = false;
    this.due = performance.now() + 1000 * period;
  }
}
