// Copyright 2026 psd_deflection maintainers
// SPDX-License-Identifier: Apache-2.0
// A calibration at the bench: its button, and a card with what is determined, what is open, and what to do next.

const $ = (id) => document.getElementById(id);
const BY = { reference: 'the reference', loads: 'known loads', self: 'the redundant reading' };
const bars = new Map();

export function calibrating(press, act) {
  press('calibrate', () => act('/api/calibrate', { calibrate: $('calibrate').getAttribute('aria-pressed') !== 'true' }));
}

export function showCalibration(found) {
  $('calibration').hidden = !found;
  const running = Boolean(found && found.running);
  $('calibrate').setAttribute('aria-pressed', String(running));
  $('calibrate').textContent = running ? '● Calibrating' : 'Calibrate';
  if (!found) return;
  $('calibration_words').textContent = words(found);
  const parameters = found.parameters || [];
  for (const parameter of parameters) show(parameter);
  const there = new Set(parameters.map((p) => p.name));
  for (const [name, row] of bars) {
    if (!there.has(name)) {
      row.remove();
      bars.delete(name);
    }
  }
  const next = (found.needs || []).map((need) => `${need.motion} (${need.names.join(', ')})`);
  $('calibration_next').replaceChildren(...next.map((text) => Object.assign(document.createElement('li'), { textContent: text })));
  $('calibration_what').hidden = !running || next.length === 0;
}

function words(found) {
  const parts = [];
  if (found.parameters) parts.push(`${found.seconds.toFixed(0)} s, by ${BY[found.kind]}: ${found.determined} of ${found.parameters.length} determined`);
  else if (found.waiting) parts.push(found.waiting);
  else if (found.running) parts.push('begins: zero the unloaded link, then hang known loads and note each');
  if (found.rejected) parts.push(`rejected so far: ${found.rejected}`);
  if (!found.running) parts.push(found.last === 'calibrated' ? `calibrated: ${found.out}/rig.yaml, report.html` : found.last);
  return parts.join('; ');
}

function show(parameter) {
  let row = bars.get(parameter.name);
  if (!row) {
    row = document.createElement('div');
    row.append(document.createElement('dt'), document.createElement('dd'));
    row.firstChild.textContent = parameter.name;
    bars.set(parameter.name, row);
    $('calibration_bars').append(row);
  }
  row.title = `${parameter.words}: ${parameter.determined ? parameter.value : 'open'}`;
  row.className = parameter.determined ? '' : 'quiet';
  if (!parameter.determined) {
    row.lastChild.textContent = 'open';
    return;
  }
  let meter = row.querySelector('meter');
  if (!meter) {
    meter = document.createElement('meter');
    row.lastChild.replaceChildren(meter);
  }
  meter.value = parameter.filled;
  meter.setAttribute('aria-label', row.title);
}
