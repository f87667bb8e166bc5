/* What the theme leaves to a reader without a mouse or a screen: what scrolls takes the keyboard,
and what has a role has a name. */
"use strict";
function addAccess() {
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
