// The theme wraps wide tables in boxes that scroll, and forgets that they must be reached by keyboard.
new MutationObserver(() => {
  for (const box of document.querySelectorAll('.md-typeset__scrollwrap:not([tabindex])')) box.tabIndex = 0;
}).observe(document.documentElement, { childList: true, subtree: true });
