// Copyright 2026 psd_deflection maintainers
// SPDX-License-Identifier: Apache-2.0
// What the theme makes while the page loads, named for screen readers and reachable by keyboard.
new MutationObserver(() => {
  for (const box of document.querySelectorAll(':is(.md-typeset__scrollwrap, pre > code):not([tabindex])')) box.tabIndex = 0;
  document.querySelectorAll('.md-code__nav:not([aria-label])').forEach((nav, i) => nav.setAttribute('aria-label', `code block ${nav.parentElement.id || i}`));
}).observe(document.documentElement, { childList: true, subtree: true, attributeFilter: ['tabindex'] });
