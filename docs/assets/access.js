/* What the theme leaves to a reader without a mouse or a screen: what scrolls takes the keyboard,
and what has a role has a name. Long lines of code are broken, those of drawings are not. */
"use strict";
// A drawing in characters: a row of dashes, or a line of nothing but a bar.
const DRAWING = /-{12}|^\s+\|\s*$/m;
// Between the cells of what a command prints in columns
const GAP = /\S {3,}\S/g;
const MIN_GAPS = 3;
function addAccess() {
  for (const code of document.querySelectorAll("pre > code")) {
    code.classList.toggle("wraps", !DRAWING.test(code.textContent));
    code.classList.toggle("columns", (code.textContent.match(GAP) ?? []).length >= MIN_GAPS);
  }
  const search = document.querySelector(".md-search[role=dialog]");
  if (search) search.setAttribute("aria-label", "Search");
  document.querySelectorAll(".md-code__nav").forEach((nav, k) => {
    nav.setAttribute("aria-label", `Code block ${k + 1}`);
  });
  for (const block of document.querySelectorAll("pre > code, .md-typeset__scrollwrap, .md-typeset p:has(> img[src$='.svg'])")) {
    if (block.scrollWidth > block.clientWidth) block.tabIndex = 0;
    else block.removeAttribute("tabindex");
  }
  for (const head of document.querySelectorAll("th")) {
    if (!head.textContent.trim()) head.setAttribute("role", "presentation");
  }
}
document.addEventListener("DOMContentLoaded", addAccess);
window.addEventListener("load", addAccess);
window.addEventListener("resize", addAccess);
