// The lines of the panels, as the table of figures (page_figures.py) has them: name, value with its unit, and colour.

import { NONE, bytes, count, fixed, quantity, signed } from "./format.js";
import { FIGURES } from "./protocol.js";

const MOST_NAMED = 4; // clipped stars that are named
const PLACES = /\{([\w.]*)(?: ([^}]+))?\}/g; // in a figure's text: {}, {KEY} or {KEY UNIT}

const starNames = new Map(); // by HIP number, from the picture's stars

// The stars of a picture: the panels call them as the picture does.
export function nameStars(stars) {
  for (const [, , , hip, label] of stars) if (hip && label) starNames.set(hip, label);
}

function starName(star) {
  return typeof star === "number" ? starNames.get(star) || `HIP ${star}` : star;
}

function number(value, unit, digits) {
  if (!Number.isFinite(value)) return NONE;
  if (unit) return quantity(value, unit, digits);
  return digits ? fixed(value, digits) : count(value);
}

// Signed numbers hold together by twos: of four, two stand in each line where there is no room for all.
function signedAll(values, unit, digits) {
  const pairs = [];
  for (let k = 0; k < values.length; k += 2) pairs.push(values.slice(k, k + 2).map((value) => signed(value, digits)).join("\u00a0\u00a0"));
  const gap = /^\w|^\u00b0/.test(unit) ? "\u00a0" : ""; // no space before the sign of arcminutes or arcseconds
  return pairs.join(values.length === 3 ? "\u00a0\u00a0" : "  ") + gap + unit;
}

const FORMS = {
  number,
  share: (value, unit, digits) => number(100 * value, unit, digits),
  signed: signedAll,
  text: (value) => value,
  clause: (value) => value.split(": ")[0], // the whole text is under Events
  clock: (synchronised) => (synchronised ? "time exchange" : "arrivals (excludes the minimum delay)"),
  reasons: (counts) => Object.entries(counts).map(([reason, n]) => `${n} ${reason}`).join(", "),
  clipped: (stars) => stars.length && `${stars.length}: ${stars.slice(0, MOST_NAMED).map(starName).join(", ")}${stars.length > MOST_NAMED ? ", \u2026" : ""}`,
};

// Figures that choose their own text and colour, whatever their value is.
const OWN_FORMS = {
  ledger: (ledger) => {
    if (!ledger) return ["not written", "warn"];
    return ledger.failing ? [`FAILING: ${ledger.failing}`, "bad"] : [`${ledger.path}  ${bytes(ledger.bytes)}`, ""];
  },
};

function valueOf(state, key) {
  return key.split(".").reduce((part, name) => part?.[name], state) ?? null;
}

// A value over zero, or not empty.
function stands(value) {
  return typeof value === "object" ? Object.keys(value).length > 0 : Boolean(value);
}

function lineOf({ key, unit, digits, form, text, none, shade }, state) {
  const value = valueOf(state, key);
  if (OWN_FORMS[form]) return OWN_FORMS[form](value);
  const shown = value === null ? "" : FORMS[form](value, unit, digits);
  if (shown === "" || shown === 0 || shown === NONE) return [none, ""];
  const whole = text.replace(PLACES, (_, other, otherUnit) => {
    if (!other) return shown;
    const beside = valueOf(state, other);
    return typeof beside === "string" ? beside : number(beside, otherUnit || unit, digits);
  });
  return [whole.trim(), stands(value) ? shade : ""];
}

// Write the figures of a panel into its rows, from the state or a part of it.
export function writeFigures(panel, state, rows) {
  for (const figure of FIGURES) if (figure.panel === panel) rows.set(figure.name, ...lineOf(figure, state));
}
