// Copyright 2026 psd_deflection maintainers
// SPDX-License-Identifier: Apache-2.0
const done = arguments[arguments.length - 1];
// Colours on their way to others are not those that a person sees.
for (const way of document.getAnimations()) if (way.effect.getComputedTiming().endTime !== Infinity) way.finish();
axe.run(document, {resultTypes: ['violations']}).then(
  (found) => done(found.violations.map(
    (v) => [v.id, v.help, v.nodes.map((n) => [n.target.join(' '), n.failureSummary])],
  )),
  (error) => done([['axe', String(error), []]]),
);
