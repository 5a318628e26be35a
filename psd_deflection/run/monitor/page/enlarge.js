// Copyright 2026 psd_deflection maintainers
// SPDX-License-Identifier: Apache-2.0
// One plot or detector as large as the window, until its button or Escape is pressed.

const LARGE = 'large';

export function enlargeable(figures) {
  for (const figure of figures) {
    const button = document.createElement('button');
    button.type = 'button';
    button.className = 'enlarge';
    button.textContent = '⤢';
    button.setAttribute('aria-label', 'as large as the window');
    button.title = 'as large as the window; Escape: back';
    figure.querySelector('figcaption').append(button);
    button.onclick = () => set(figure, !figure.classList.contains(LARGE));
  }
  document.addEventListener('keydown', (event) => {
    const large = document.querySelector(`figure.${LARGE}`);
    if (event.key === 'Escape' && large) set(large, false);
  });
}

function set(figure, large) {
  figure.classList.toggle(LARGE, large);
  const button = figure.querySelector('.enlarge');
  button.setAttribute('aria-pressed', String(large));
  // What lies under it is not reached with the keyboard.
  for (const other of document.querySelectorAll('header, .numbers, .detectors, .windows, .health, figure')) {
    if (other !== figure && !other.contains(figure)) other.inert = large;
  }
  button.focus();
}
