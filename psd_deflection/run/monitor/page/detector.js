// Copyright 2026 psd_deflection maintainers
// SPDX-License-Identifier: Apache-2.0
// One detector as it is looked at along the beam's arrival: active area, millimetre grid, trail, dot.

const TRAIL_S = 2.0;
const STEPS = 12;

export class Detector {
  constructor(figure, number, area, color) {
    this.figure = figure;
    this.number = number;
    this.area = area;
    this.color = color;
    this.canvas = figure.querySelector('canvas');
    this.canvas.style.aspectRatio = `${area[0]} / ${area[1]}`;
    this.place = figure.querySelector('.place');
    this.bar = figure.querySelector('.bar i');
    this.mark = figure.querySelector('.bar b');
    this.volts = figure.querySelector('.volts');
  }

  draw(rows, hello, seen) {
    const canvas = this.canvas;
    const ratio = window.devicePixelRatio || 1;
    const width = Math.round(canvas.clientWidth * ratio);
    const height = Math.round(canvas.clientHeight * ratio);
    if (width === 0 || height === 0) return;
    if (canvas.width !== width || canvas.height !== height) {
      canvas.width = width;
      canvas.height = height;
    }
    const g = canvas.getContext('2d');
    const color = this.color;
    const scale = 0.94 * Math.min(width / this.area[0], height / this.area[1]);
    const px = (x) => width / 2 + x * scale;
    const py = (y) => height / 2 - y * scale;
    g.clearRect(0, 0, width, height);
    g.fillStyle = color('--plate');
    g.fillRect(px(-this.area[0] / 2), py(this.area[1] / 2), this.area[0] * scale, this.area[1] * scale);
    this.grid(g, px, py, ratio);
    const x = rows.last(`x${this.number}`);
    const y = rows.last(`y${this.number}`);
    if (x === null || y === null) return;
    this.trail(g, rows, px, py, ratio);
    g.globalAlpha = seen ? 1 : 0.35;
    g.fillStyle = color('--laser');
    g.shadowColor = color('--laser');
    g.shadowBlur = seen ? 10 * ratio : 0;
    g.beginPath();
    g.arc(px(x), py(y), 5 * ratio, 0, 2 * Math.PI);
    g.fill();
    g.shadowBlur = 0;
    g.globalAlpha = 1;
  }

  grid(g, px, py, ratio) {
    const [halfX, halfY] = [this.area[0] / 2, this.area[1] / 2];
    const step = 10 ** Math.floor(Math.log10(Math.max(halfX, halfY) / 2));
    g.lineWidth = ratio;
    g.strokeStyle = this.color('--grid');
    g.beginPath();
    for (let x = step; x < halfX; x += step) {
      for (const s of [-x, x]) { g.moveTo(px(s), py(-halfY)); g.lineTo(px(s), py(halfY)); }
    }
    for (let y = step; y < halfY; y += step) {
      for (const s of [-y, y]) { g.moveTo(px(-halfX), py(s)); g.lineTo(px(halfX), py(s)); }
    }
    g.stroke();
    g.strokeStyle = this.color('--line');
    g.beginPath();
    g.moveTo(px(-halfX), py(0)); g.lineTo(px(halfX), py(0));
    g.moveTo(px(0), py(-halfY)); g.lineTo(px(0), py(halfY));
    g.stroke();
    g.strokeStyle = this.color('--quiet');
    g.strokeRect(px(-halfX), py(halfY), px(halfX) - px(-halfX), py(-halfY) - py(halfY));
    g.fillStyle = this.color('--quiet');
    g.font = `${11 * ratio}px system-ui, sans-serif`;
    g.textAlign = 'right';
    g.fillText('x', px(halfX) - 4 * ratio, py(0) - 4 * ratio);
    g.textAlign = 'left';
    g.fillText('y', px(0) + 4 * ratio, py(halfY) + 13 * ratio);
    g.fillText(`${Number((step * 1e3).toPrecision(1))} mm grid`, px(-halfX) + 4 * ratio, py(-halfY) - 5 * ratio);
  }

  // Older is fainter, in a dozen strokes.
  trail(g, rows, px, py, ratio) {
    const newest = rows.last('t');
    const first = rows.from(newest - TRAIL_S);
    const [xs, ys] = rows.slices([`x${this.number}`, `y${this.number}`], first);
    g.strokeStyle = this.color('--laser');
    g.lineWidth = 1.5 * ratio;
    g.lineJoin = 'round';
    for (let k = 0; k < STEPS; k++) {
      const from = Math.floor((k * (xs.length - 1)) / STEPS);
      const to = Math.floor(((k + 1) * (xs.length - 1)) / STEPS);
      g.globalAlpha = 0.75 * ((k + 1) / STEPS) ** 2;
      g.beginPath();
      let pen = false;
      for (let i = from; i <= to; i++) {
        if (xs[i] === null || ys[i] === null) pen = false;
        else if (pen) g.lineTo(px(xs[i]), py(ys[i]));
        else { g.moveTo(px(xs[i]), py(ys[i])); pen = true; }
      }
      g.stroke();
    }
    g.globalAlpha = 1;
  }

  // The figures beside it; called a few times a second, a number that flickers cannot be read.
  write(rows, hello) {
    const x = rows.last(`x${this.number}`);
    const y = rows.last(`y${this.number}`);
    const volts = rows.last(`sum${this.number}`);
    const full = 1.5 * hello.sum_nominal;
    this.place.textContent = x === null || y === null ? '' : `x ${signed(x * 1e3, 3)}  y ${signed(y * 1e3, 3)} mm`;
    this.volts.textContent = volts === null ? '–' : `${volts.toFixed(3)} V`;
    this.bar.style.transform = `scaleX(${Math.min(1, Math.max(0, (volts ?? 0) / full))})`;
    this.mark.style.left = `${(100 * hello.sum_min) / full}%`;
    this.figure.classList.toggle('low', volts !== null && volts < hello.sum_min);
    this.canvas.dataset.x = x === null ? '' : String(x);
    this.canvas.dataset.y = y === null ? '' : String(y);
  }
}

export function signed(value, digits) {
  // U+2212 is as wide as the plus sign.
  const text = Math.abs(value).toFixed(digits);
  return (value < 0 && Number(text) !== 0 ? '\u2212' : '+') + text;
}
