// Copyright 2026 psd_deflection maintainers
// SPDX-License-Identifier: Apache-2.0
// The last rows, column by column, in arrays that never grow: each is twice as long as what it
// keeps, and its newer half moves to the front when it is full. The arrays are of bare numbers, so
// that the heap is as large when they are full as when they are empty; NaN stands for null.

const present = (value) => (Number.isNaN(value) ? null : value);

export class Rows {
  constructor(names, capacity) {
    this.capacity = capacity;
    this.index = new Map(names.map((name, i) => [name, i]));
    this.columns = names.map(() => new Float64Array(2 * capacity));
    this.clear();
  }

  clear() {
    this.end = 0;
  }

  get start() {
    return Math.max(0, this.end - this.capacity);
  }

  get empty() {
    return this.end === 0;
  }

  push(values) {
    if (this.end === 2 * this.capacity) {
      for (const column of this.columns) column.copyWithin(0, this.capacity);
      this.end = this.capacity;
    }
    for (let i = 0; i < this.columns.length; i++) this.columns[i][this.end] = values[i] ?? NaN;
    this.end += 1;
  }

  // The value `back` rows before the newest.
  last(name, back = 0) {
    const i = this.end - 1 - back;
    return i < this.start ? null : present(this.columns[this.index.get(name)][i]);
  }

  // Index of the first row with t >= `t`; t rises.
  from(t) {
    const column = this.columns[this.index.get('t')];
    let low = this.start;
    let high = this.end;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (column[middle] < t) low = middle + 1;
      else high = middle;
    }
    return low;
  }

  slices(names, first) {
    return names.map((name) => {
      // An array of bare numbers too, unless a value is missing.
      const slice = Array.from(this.columns[this.index.get(name)].subarray(first, this.end));
      for (let i = 0; i < slice.length; i++) if (Number.isNaN(slice[i])) slice[i] = null;
      return slice;
    });
  }
}
