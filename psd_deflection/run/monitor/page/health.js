// Copyright 2026 psd_deflection maintainers
// SPDX-License-Identifier: Apache-2.0
// Rates, losses, health and messages, as text.

import { loadText } from '/page/charts.js';

const MESSAGES = 50;
const $ = (id) => document.getElementById(id);

const TILES = [
  ['samples/s', 'rate (samples/s)'], ['estimates/s', 'rate (estimates/s)'], ['lost samples', 'lost'], ['bad frames', 'bad frames'],
  ['dropped, queue', 'dropped by a full queue'], ['dropped, device', 'dropped by the device'], ['disconnects', 'disconnects'],
  ['latency, median (ms)', 'latency, median (ms)'], ['latency, worst (ms)', 'latency, worst of a second (ms)'],
  ['clock skew (ppm)', 'skew (ppm)'], ['clock residual (µs)', 'residual (us)'],
  ['χ² of the readings', 'chi-square of the readings'], ['contradicting blocks', 'blocks whose readings contradict each other'],
];
const LOSSES = new Set(['blocks whose readings contradict each other', 'lost', 'bad frames', 'dropped by a full queue', 'dropped by the device', 'disconnects']);

export function showReport(found) {
  const values = new Map(found.entries.filter((e) => e.name !== 'recording').flatMap((e) => e.values));
  const tiles = TILES.filter(([, key]) => values.has(key)).map(([label, key]) => [label, values.get(key), LOSSES.has(key) && values.get(key) !== '0']);
  if (found.load) tiles.push(['known load', loadText(...found.load), false]);
  tiles.push(['not shown (page too slow)', String(found.dropped), found.dropped > 0]);
  list($('tiles'), tiles);
  const there = new Set();
  for (const entry of found.entries) {
    there.add(entry.name);
    let details = $('entries').querySelector(`[data-name="${CSS.escape(entry.name)}"]`);
    if (!details) {
      details = document.createElement('details');
      details.dataset.name = entry.name;
      details.append(document.createElement('summary'), document.createElement('dl'));
      details.firstChild.append(document.createElement('b'), document.createElement('span'));
      $('entries').append(details);
    }
    details.className = `level-${entry.level}`;
    details.querySelector('b').textContent = `${entry.name} `;
    details.querySelector('span').textContent = entry.message;
    list(details.querySelector('dl'), entry.values);
  }
  for (const details of [...$('entries').children]) if (!there.has(details.dataset.name)) details.remove();
}

// Writes into the elements that are there: a list made anew every second would shed garbage.
function list(element, pairs) {
  while (element.children.length > 2 * pairs.length) element.lastChild.remove();
  while (element.children.length < 2 * pairs.length) element.append(document.createElement(element.children.length % 2 ? 'dd' : 'dt'));
  pairs.forEach(([label, value, bad], i) => {
    const [dt, dd] = [element.children[2 * i], element.children[2 * i + 1]];
    if (dt.textContent !== label) dt.textContent = label;
    if (dd.textContent !== value) dd.textContent = value;
    dd.classList.toggle('bad', Boolean(bad));
  });
}

export function tell(t, text) {
  const messages = $('messages');
  const item = document.createElement('li');
  const time = document.createElement('time');
  time.textContent = new Date(t * 1000).toLocaleTimeString([], { hour12: false });
  item.append(time, text);
  messages.prepend(item);
  while (messages.children.length > MESSAGES) messages.lastChild.remove();
}
