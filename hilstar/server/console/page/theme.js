// The light or dark theme, by the system's setting or the user's choice, and the colours for canvases, read from the style sheet.

import { byId } from "./format.js";

const KEY = "hilstar.theme";
const ORDER = ["auto", "light", "dark"];
const WORDS = { auto: "Theme: auto", light: "Theme: light", dark: "Theme: dark" };
const INKS = {
  muted: "--muted", accent: "--accent", bad: "--bad", warn: "--warn", ok: "--ok", gridLine: "--line", axis: "--edge", one: "--series-1", two: "--series-2", three: "--series-3",
  skyGround: "--sky-ground", skyLine: "--sky-line", skyText: "--sky-text", star: "--sky-star", galaxy: "--sky-galaxy", ecliptic: "--sky-ecliptic",
  field: "--sky-field", fieldFill: "--sky-fill", trail: "--sky-trail", moving: "--sky-moving",
};

export const ink = { theme: "" };

function stored() {
  try {
    return localStorage.getItem(KEY) || "auto";
  } catch {
    return "auto";
  }
}

export function readInks() {
  const style = getComputedStyle(document.documentElement);
  for (const [name, property] of Object.entries(INKS)) ink[name] = style.getPropertyValue(property).trim();
  ink.theme = document.documentElement.dataset.theme;
}

// `onPrint` draws what has the theme's colours, and no picture: a browser prints one that is drawn just then as vectors, wrongly.
export function startTheme(onChange, onPrint) {
  const button = byId("theme");
  let chosen = stored();
  const dark = matchMedia("(prefers-color-scheme: dark)");
  const apply = () => {
    document.documentElement.dataset.theme = chosen === "auto" ? (dark.matches ? "dark" : "light") : chosen;
    button.textContent = WORDS[chosen];
    readInks();
    onChange();
  };
  button.addEventListener("click", () => {
    chosen = ORDER[(ORDER.indexOf(chosen) + 1) % ORDER.length];
    try {
      localStorage.setItem(KEY, chosen);
    } catch {
      // Without storage the choice lasts as long as the page.
    }
    apply();
  });
  dark.addEventListener("change", apply);
  // Canvases stay in the colours in which they were drawn: for printing they are drawn again in the light ones.
  window.addEventListener("beforeprint", () => {
    document.documentElement.dataset.theme = "light";
    readInks();
    onPrint();
  });
  window.addEventListener("afterprint", apply);
  apply();
}
