// What the theme makes while the page loads, named for screen readers and reachable by keyboard.
new MutationObserver(() => {
  for (const box of document.querySelectorAll('.md-typeset__scrollwrap:not([tabindex])')) box.tabIndex = 0;
  document.querySelectorAll('.md-code__nav').forEach((nav, i) => nav.setAttribute('aria-label', `code block ${i + 1}`));
}).observe(document.documentElement, { childList: true, subtree: true });
