// Copyright 2026 psd_deflection maintainers
// SPDX-License-Identifier: Apache-2.0
// Connects, keeps the last minute, draws. Nothing here grows with time: the rows are a ring, the messages a list of
// fifty, of the hours the last answer, and whatever is drawn is drawn into what is there.

import { History } from '/page/cells.js';
import { clock, loadText } from '/page/charts.js';
import { Detector, signed } from '/page/detector.js';
import { showReport, tell } from '/page/health.js';
import { Plots } from '/page/plots.js';
import { Rows } from '/page/rows.js';
import { enlargeable } from '/page/enlarge.js';
import { calibrating, showCalibration } from '/page/calibrate.js';
import { weighing } from '/page/weigh.js';

const TRACES_MS = 80;
const NUMBERS_MS = 150;
const STALE_MS = 1500;
const SILENT_MS = 4000;
const RETRY_MS = [300, 600, 1200, 2500];
const GAP_BLOCKS = 3.5;
const MARKS = 200;

const $ = (id) => document.getElementById(id);
const body = document.body;
const styles = getComputedStyle(document.documentElement);
const color = (name) => styles.getPropertyValue(name).trim();

const BANDS = ['dx_low', 'dx_high', 'dy_low', 'dy_high', 'theta_low', 'theta_high'];
// What is kept of a row; its columns depend on the number of PSDs.
let KEEP = [];
const MICRO = 1e6;
const MDEG = (180 / Math.PI) * 1e3;
const SCALES = { dx: MICRO, dy: MICRO, theta: MDEG };

let hello = null;
let rows = null;
let references = null;
let plots = null;
let detectors = [];
let health = null;
let socket = null;
let heard = 0;
let fresh = false;
let density;
let newDensity = false;
let attempts = 0;
let rejection = '';
let received = 0;
let lastRowAt = 0;
let token = takeToken();
// Of the traces, s. Beyond what the page has itself, the daemon is asked.
let span = 30;
const past = new History((cells) => plots.history(cells), (why) => notice(why, true));

function takeToken() {
  const given = new URLSearchParams(location.hash.slice(1)).get('token');
  if (given) {
    sessionStorage.setItem('token', given);
    history.replaceState(null, '', location.pathname);
  }
  return given || sessionStorage.getItem('token') || '';
}

// From the server.

function connect() {
  socket = new WebSocket(`ws://${location.host}/ws`);
  heard = performance.now();
  socket.onmessage = (event) => {
    heard = performance.now();
    take(JSON.parse(event.data));
  };
  socket.onclose = (event) => {
    rejection = event.reason;
    setTimeout(connect, RETRY_MS[Math.min(attempts, RETRY_MS.length - 1)]);
    attempts += 1;
    showState();
  };
}

function take(message) {
  if (message.hello) greet(message.hello);
  if (message.rows) message.rows.forEach(takeRow);
  if (message.marks) message.marks.forEach(takeMark);
  if (message.references) message.references.forEach(takeReference);
  if (message.messages) message.messages.forEach(([t, text]) => tell(t, text));
  if (message.health) showHealth(message.health);
  if ('spectrum' in message) {
    density = message.spectrum;
    newDensity = true;
  }
}

function greet(found) {
  attempts = 0;
  const other = hello === null || JSON.stringify([hello.rows, hello.frequency, hello.active_areas, hello.modes])
    !== JSON.stringify([found.rows, found.frequency, found.active_areas, found.modes]);
  const anew = hello !== null && hello.instance !== found.instance;
  hello = found;
  hello.at = Object.fromEntries(found.columns.map((name, i) => [name, i]));
  if (other) {
    const psds = found.active_areas.map((_, i) => i + 1);
    KEEP = ['t', ...psds.flatMap((n) => [`x${n}`, `y${n}`]), ...psds.map((n) => `sum${n}`),
      'dx', 'dy', 'theta', 'sd_dx', 'sd_dy', 'sd_theta', 'lost', 'status', ...BANDS];
    blank = KEEP.map((name) => (name === 'lost' ? 1 : null));
    row = new Array(KEEP.length).fill(null);
    rows = new Rows(KEEP, found.rows);
    further(psds.length);
    references = new Rows(['t', 'dx', 'dy', 'theta'], found.rows);
    detectors = psds.map((n) => new Detector($(`detector_${n}`), n, found.active_areas[n - 1], color));
    if (plots) {
      plots.hello = found;
      plots.references = references;
      plots.cells = null;
      plots.build();
    } else plots = new Plots(found, color, references, zoomed, recall('scale each') === 'on');
  }
  startOver();
  $('spectrum_s').textContent = String(Number(found.spectrum_s.toPrecision(2)));
  if (anew) notice('connected to a daemon that was started anew');
  body.dataset.instance = found.instance;
  $('messages').replaceChildren();
  buttons();
}

// The figures and the keys of the PSDs beyond the second, made like those that every rig has.
function further(psds) {
  for (const element of document.querySelectorAll('.further')) element.remove();
  const after = (last, like, id) => {
    const made = like.cloneNode(true);
    made.classList.add('further');
    if (id) made.id = id;
    last.after(' ', made);
    return made;
  };
  let figure = $('detector_2');
  let sum = document.querySelector('.key[data-plot="sums"][data-series="2"]');
  let key = document.querySelector('.key[data-plot="spectrum"][data-series="4"]');
  const name = (button, series, text, name) => {
    button.className = `key further ${name}`;
    button.dataset.series = String(series);
    button.firstChild.textContent = `${text} `;
  };
  for (let n = 3; n <= psds; n++) {
    figure = after(figure, $('detector_2'), `detector_${n}`);
    figure.querySelector('figcaption').firstChild.textContent = `PSD ${n} `;
    figure.querySelector('canvas').setAttribute('aria-label', `dot on PSD ${n}`);
    sum = after(sum, sum);
    name(sum, n, `sum ${n}`, `c-x${n}`);
    for (const [i, axis] of ['x', 'y'].entries()) {
      key = after(key, key);
      name(key, 2 * n - 1 + i, `${axis}${n}`, `c-${axis}${n}`);
    }
  }
}

function startOver() {
  rows.clear();
  references.clear();
  plots.marks.length = 0;
  past.renew();
  showReferences();
}

function takeMark(mark) {
  const { marks } = plots;
  marks.push(mark);
  if (marks.length > MARKS) marks.shift();
  fresh = true;
}

function takeReference([t, dx, dy, theta]) {
  const last = references.last('t');
  if (last !== null && t <= last) references.clear();
  references.push([t, dx * MICRO, dy * MICRO, theta * MDEG]);
  showReferences();
  fresh = true;
}

function showReferences() {
  for (const key of document.querySelectorAll('.references')) key.hidden = references.empty;
}

// Breaks the traces where blocks are gone altogether, and is marked as lost.
let blank = [];
let row = [];

function takeRow(values) {
  const at = hello.at;
  const t = values[at.t];
  const last = rows.last('t');
  if (last !== null && t <= last) startOver();
  else if (last !== null && t - last > GAP_BLOCKS * hello.block_s) {
    blank[0] = last + hello.block_s;
    rows.push(blank);
  }
  let i = KEEP.length - BANDS.length;
  for (let k = 0; k < i; k++) row[k] = values[at[KEEP[k]]];
  for (const name of ['dx', 'dy', 'theta']) {
    const [k, s] = [at[name], at[`sd_${name}`]];
    const scale = SCALES[name];
    const there = values[k] !== null;
    row[KEEP.indexOf(name)] = there ? values[k] * scale : null;
    row[KEEP.indexOf(`sd_${name}`)] = there ? values[s] * scale : null;
    row[i++] = there ? (values[k] - 2 * values[s]) * scale : null;
    row[i++] = there ? (values[k] + 2 * values[s]) * scale : null;
  }
  rows.push(row);
  received += 1;
  lastRowAt = performance.now();
  fresh = true;
}

// To the eye.

// When the first traces were drawn, for whoever measures the first load.
let drawn = null;
let tracesAt = 0;
let numbersAt = 0;

function frame(now) {
  requestAnimationFrame(frame);
  if (!hello || document.hidden) return;
  if (fresh && !held()) {
    if (now - tracesAt >= TRACES_MS) {
      tracesAt = now;
      fresh = false;
      if (!rows.empty && !past.span) plots.traces(rows, span);
      if (!rows.empty && !drawn) drawn = performance.mark('drawn');
    }
    const seen = rows.last('status') === 0;
    for (const detector of detectors) detector.draw(rows, hello, seen);
  }
  past.tick(now, rows.last('t'), held(), plots.width);
  if (newDensity && !held()) {
    newDensity = false;
    plots.spectrum(density);
  }
  if (now - numbersAt >= NUMBERS_MS) {
    numbersAt = now;
    numbers();
    showState();
  }
}

function hold(wanted) {
  $('hold').setAttribute('aria-pressed', String(wanted));
  $('hold').textContent = wanted ? 'Held' : 'Hold';
  if (wanted) return;
  fresh = true;
  past.zoom(null);
}

// A stretch of the traces was chosen, or left (null).
function zoomed(range) {
  hold(range !== null);
  if (range) past.zoom(range);
}

const held = () => $('hold').getAttribute('aria-pressed') === 'true';

function numbers() {
  body.dataset.rows = String(received);
  showPosition();
  if (rows.empty || held()) return;
  for (const name of ['dx', 'dy', 'theta']) {
    const value = rows.last(name);
    const sd = rows.last(`sd_${name}`);
    $(name).textContent = value === null ? '–' : signed(value, 2);
    $(`sd_${name}`).textContent = value === null ? '' : `± ${sd.toFixed(2)}`;
  }
  for (const detector of detectors) detector.write(rows, hello);
}

function showState() {
  const now = performance.now();
  let [state, text] = ['live', 'live'];
  if (socket.readyState !== WebSocket.OPEN) [state, text] = hello ? ['offline', 'connection lost, trying again'] : ['connecting', rejection || 'connecting'];
  else if (!hello) [state, text] = ['connecting', 'connecting'];
  else if (now - heard > SILENT_MS) {
    // A connection that says nothing is none, whatever the browser thinks of it.
    [state, text] = ['offline', 'connection lost, trying again'];
    socket.close();
  } else if (health && health.seeking) [state, text] = ['live', 'seeking'];
  else if (health && health.paused) [state, text] = ['live', 'paused'];
  else if (received === 0) [state, text] = ['connecting', 'waiting for samples'];
  else if (now - lastRowAt > Math.max(STALE_MS, 3000 * hello.block_s)) [state, text] = hello.kind === 'replay' ? ['ended', 'end of recording'] : ['stale', 'no samples'];
  else {
    const status = rows.last('status');
    if (status > 0) [state, text] = ['rejected', hello.statuses[status]];
    else if (held()) text = 'live, held';
    else if (hello.kind === 'replay') text = 'playing';
  }
  if (body.dataset.state !== state) {
    body.dataset.state = state;
    if (hello) buttons();
  }
  if ($('state').textContent !== text) $('state').textContent = text;
  const kinds = { simulated: 'simulated rig on', live: '', replay: 'recording' };
  const source = hello ? `${kinds[hello.kind]} ${hello.name}`.trim() : '';
  if ($('source').textContent !== source) $('source').textContent = source;
  const title = `${text} · ${source || 'psd_deflection'}`;
  if (document.title !== title) document.title = title;
}

function showHealth(found) {
  health = found;
  hello.kind = found.kind;
  hello.name = found.name;
  hello.sum_min = found.sum_min;
  showReport(found);
  buttons();
}

// From the hand.

// Why a button does nothing now; '' if it works.
function rejected(id) {
  if (!hello || body.dataset.state === 'offline') return 'there is no connection to the daemon';
  if (!hello.control) return hello.why_no_control;
  if (hello.kind === 'replay' && id === 'record') return 'a recording is played; it is not recorded again';
  if (hello.kind === 'replay' && id === 'calibrate') return 'a recording is played; psd-deflection calibrate takes it';
  if (hello.kind === 'replay' && id === 'mark') return 'a recording is played; its marks are those that were recorded';
  if (hello.kind === 'replay' && id === 'load') return 'a recording is played; its loads are those that were recorded';
  return '';
}

const TITLES = new Map(['mark', 'load', 'zero', 'record', 'calibrate'].map((id) => [id, $(id).title]));

function buttons() {
  const recording = Boolean(health && health.recording);
  // Not `disabled`: a button that cannot be reached cannot say why.
  for (const [id, title] of TITLES) {
    const why = rejected(id);
    $(id).setAttribute('aria-disabled', String(why !== ''));
    $(id).title = why || title;
  }
  $('record').setAttribute('aria-pressed', String(recording));
  $('record').textContent = recording ? '● Recording' : 'Record';
  if (recording) $('record').title = health.recording;
  showCalibration(health && health.calibration);
  $('held').textContent = health && health.load ? loadText(...health.load) : 'nothing';
  showPlayer();
}

function press(id, action) {
  $(id).onclick = () => {
    const why = rejected(id);
    if (why) notice(why, true);
    else action();
  };
}

// A recording that is played.

let seeking = false;

function showPlayer() {
  $('player').hidden = hello.kind !== 'replay';
  if (hello.kind !== 'replay') return;
  const stopped = (health && health.paused) || body.dataset.state === 'ended';
  const words = stopped ? 'Play' : 'Pause';
  if ($('pause').textContent !== words) $('pause').textContent = words;
  const span = health && health.span;
  $('seek').disabled = !span;
  if (span) $('seek').max = String(span[1] - span[0]);
  showPosition();
}

function showPosition() {
  const span = health && health.span;
  if (!hello || hello.kind !== 'replay' || !span || rows.empty) return;
  if (!seeking) $('seek').value = String(rows.last('t') - span[0]);
  const text = `${Number($('seek').value).toFixed(1)} of ${(span[1] - span[0]).toFixed(1)} s`;
  if ($('position').textContent !== text) {
    $('position').textContent = text;
    $('seek').setAttribute('aria-valuetext', `${text}, ${clock(span[0] + Number($('seek').value), 1)}`);
  }
}

const TIMED = ['/api/mark', '/api/load', '/api/zero'];

function notice(text, bad = false) {
  $('notice').textContent = text;
  $('notice').className = bad ? 'bad' : '';
  $('notice').hidden = false;
  clearTimeout(notice.timer);
  notice.timer = setTimeout(() => { $('notice').hidden = true; }, 8000);
}

// A mark or a load is of the moment of its click, however long the token and the network take.
async function act(path, content, quiet = false) {
  const clicked = performance.now();
  if (hello.needs_token && !token && !(token = await askToken())) return null;
  try {
    const answer = await fetch(path, {
      method: 'POST',
      headers: { 'Content-Type': 'application/json', ...(token ? { 'X-Monitor-Token': token } : {}) },
      body: JSON.stringify(TIMED.includes(path) ? { ...content, late: (performance.now() - clicked) / 1000 } : content),
    });
    const result = await answer.json();
    if (answer.status === 401) {
      token = '';
      sessionStorage.removeItem('token');
    }
    if (!quiet || !result.ok) notice(result.message, !result.ok);
    return result;
  } catch {
    notice('no answer: the connection is lost', true);
    return null;
  }
}

function askToken() {
  return new Promise((resolve) => {
    const ask = $('ask');
    ask.onclose = () => {
      const given = ask.returnValue === 'ok' ? $('token').value.trim() : '';
      if (given) sessionStorage.setItem('token', given);
      $('token').value = '';
      resolve(given);
    };
    ask.returnValue = '';
    ask.showModal();
  });
}

// A moment is marked at once; without a text it gets the next number.
press('mark', () => {
  const texts = new Set(plots.marks.filter(([, kind]) => kind === 'mark').map(([, , text]) => text));
  let number = 1;
  while (texts.has(`mark ${number}`)) number += 1;
  act('/api/mark', { text: $('mark_text').value.trim() || `mark ${number}` });
  $('mark_text').value = '';
});
$('mark_text').onkeydown = (event) => { if (event.key === 'Enter') $('mark').click(); };
press('zero', () => act('/api/zero', {}));
press('record', () => act('/api/record', { record: !(health && health.recording) }));
enlargeable(document.querySelectorAll('figure.plot'));
weighing(press, act);
calibrating(press, act);
$('cancel').onclick = () => $('ask').close('');

// What this browser remembers for the next visit.

function recall(name) {
  try {
    return localStorage.getItem(name);
  } catch {
    return null;
  }
}

function remember(name, value) {
  try {
    localStorage.setItem(name, value);
  } catch {
    // A browser that keeps nothing.
  }
}

const windows = [...document.querySelectorAll('.windows [data-span]')];

function look(seconds) {
  span = seconds;
  remember('window', String(seconds));
  for (const button of windows) button.setAttribute('aria-pressed', String(Number(button.dataset.span) === seconds));
  past.look(seconds > 60 ? seconds : 0);
  if (plots && !past.span) plots.live();
  hold(false);
}

for (const button of windows) button.onclick = () => look(Number(button.dataset.span));
look(windows.map((b) => Number(b.dataset.span)).find((s) => String(s) === recall('window')) ?? 30);
$('each').setAttribute('aria-pressed', String(recall('scale each') === 'on'));
$('each').onclick = () => {
  const wanted = $('each').getAttribute('aria-pressed') !== 'true';
  $('each').setAttribute('aria-pressed', String(wanted));
  remember('scale each', wanted ? 'on' : 'off');
  if (!plots) return;
  plots.each = wanted;
  redraw();
};
$('hold').onclick = () => hold(!held());
$('pause').onclick = () => {
  const why = rejected('zero');
  if (why) notice(why, true);
  else act('/api/play', { paused: !(health.paused || body.dataset.state === 'ended') }, true);
};
$('seek').oninput = () => {
  seeking = true;
  showPosition();
};
$('seek').onchange = async () => {
  const why = rejected('zero');
  if (why) notice(why, true);
  else await act('/api/play', { seek: Number($('seek').value) }, true);
  seeking = false;
};
function redraw() {
  plots.build(true);
  newDensity = true;
}

matchMedia('(prefers-color-scheme: dark)').onchange = () => { if (plots) redraw(); };

connect();
requestAnimationFrame(frame);
// The tab's title tells what happens while another tab is looked at, where no frames are drawn.
setInterval(showState, 1000);
