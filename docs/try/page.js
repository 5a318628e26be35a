// Copyright 2026 psd_deflection maintainers
// SPDX-License-Identifier: Apache-2.0
// The form of try.html: what is hidden goes to the worker, what the worker tells is shown.
const part = (name) => document.getElementById(`try-${name}`);
const [form, effect, size, unit, state, steps, answer, hidden, report, box] =
  ['form', 'effect', 'size', 'unit', 'state', 'steps', 'answer', 'hidden', 'report', 'box'].map(part);
const choices = [...effect.options].filter((option) => option.dataset.size);
let worker, began, ticking, runs = 0;

function choose() {
  const { size: usual, unit: of, least, most } = effect.selectedOptions[0].dataset;
  size.disabled = part('by').hidden = !usual;
  [size.value, size.min, size.max] = [usual ?? '', least ?? '', most ?? ''];
  unit.textContent = usual ? `${of}, ${least} to ${most}` : '';
}

// The words of simulate --effect: those of the option, and the size in SI units.
const words = ({ value, dataset }, amount) => `${value}=${Number((amount * dataset.si).toPrecision(4))}`;

function toHide() {
  const option = effect.selectedOptions[0];
  if (option.dataset.size) return words(option, size.valueAsNumber);
  if (option.value !== 'drawn') return '';
  const drawn = choices[Math.floor(Math.random() * choices.length)];
  const { least, most } = drawn.dataset;
  // Small ones are as likely as large ones.
  return words(drawn, least * (most / least) ** Math.random());
}

const seconds = () => ((performance.now() - began) / 1000).toFixed(1);

function step(text) {
  const line = document.createElement('li');
  line.textContent = text;
  line.dataset.at = seconds();
  if (steps.lastElementChild) steps.lastElementChild.append(` (${(seconds() - steps.lastElementChild.dataset.at).toFixed(1)} s)`);
  if (text) steps.append(line);
}

function end(outcome, text) {
  clearInterval(ticking);
  step('');
  form.elements.run.disabled = false;
  state.textContent = text;
  form.dataset.state = outcome;
}

const told = {
  step,
  answer(text) {
    if (!answer.childElementCount) form.dataset.named = seconds();
    answer.append(Object.assign(document.createElement('p'), { textContent: text }));
    box.hidden = false;
  },
  report(text) {
    report.srcdoc = text;
    report.hidden = false;
    part('save').href = URL.createObjectURL(new Blob([text], { type: 'text/html' }));
  },
  done() { end('done', `Answered after ${form.dataset.named} s, all of it in this browser.`); },
  failed(text) { end('failed', `It failed: ${text}`); },
};

form.addEventListener('submit', (event) => {
  event.preventDefault();
  const words = toHide();
  steps.replaceChildren();
  answer.replaceChildren();
  box.hidden = report.hidden = true;
  hidden.textContent = words || 'nothing';
  runs += 1;
  part('line').textContent = `psd-deflection simulate --out run --loads identification --seed ${runs}${words && ` --effect ${words}`}
psd-deflection discover run --out found`;
  form.elements.run.disabled = true;
  form.dataset.state = 'running';
  began = performance.now();
  ticking = setInterval(() => { state.textContent = `${Math.floor(seconds())} s`; }, 200);
  if (!worker) {
    worker = new Worker(new URL('try/worker.js', location.href));
    worker.onmessage = ({ data }) => told[data.kind](data.text);
    worker.onerror = (error) => told.failed(error.message);
  }
  worker.postMessage({ effect: words, seed: runs });
});

effect.addEventListener('change', choose);
choose();

fetch(new URL('try/python/pyodide-lock.json', location.href), { method: 'HEAD' }).then(({ ok }) => {
  if (!ok) throw new Error();
  form.elements.run.disabled = false;
  form.dataset.state = 'ready';
}).catch(() => {
  state.textContent = 'This copy of the site has no Python for the browser: its builder could not reach the registries.';
  form.dataset.state = 'absent';
});
