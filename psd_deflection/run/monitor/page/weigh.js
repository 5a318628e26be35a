// Copyright 2026 psd_deflection maintainers
// SPDX-License-Identifier: Apache-2.0
// The dialog that notes a known load. `press` sets what a button does, `act` asks the daemon.

const $ = (id) => document.getElementById(id);
// A field takes a decimal comma; `pattern` rejects one before three digits, which may be thousands.
const typed = (id) => Number($(id).value.trim().replace(',', '.'));

export function weighing(press, act) {
  // When the link moved last, on the clock of this page; null if that is not known, or not chosen.
  let stepAt = null;
  let since = null;
  const secondsSince = (at) => (performance.now() - at) / 1000;

  function showStep() {
    $('since_step').hidden = stepAt === null;
    if (stepAt !== null) $('since_step').textContent = `since the last step (${secondsSince(stepAt).toFixed(1)} s ago)`;
    if (since !== null) $('ago').value = secondsSince(since).toFixed(2);
  }

  press('load', async () => {
    $('weigh').returnValue = '';
    [stepAt, since] = [null, null];
    $('ago').value = '0';
    showStep();
    $('weigh').showModal();
    const found = await act('/api/step', {}, true);
    if (found && found.ok && found.message) stepAt = performance.now() - 1000 * Number(found.message);
    showStep();
  });
  setInterval(() => { if ($('weigh').open) showStep(); }, 250);
  $('since_step').onclick = () => {
    since = stepAt;
    showStep();
  };
  $('ago').oninput = () => { since = null; };
  $('weigh').onclose = () => {
    const how = $('weigh').returnValue;
    if (!how) return;
    const [fx, fy, tz] = ['fx', 'fy', 'tz'].map(typed);
    const ago = since === null ? typed('ago') : secondsSince(since);
    act('/api/load', { fx, fy, tz, add: how === 'add', ago });
  };
  $('weigh_cancel').onclick = () => $('weigh').close('');
}
