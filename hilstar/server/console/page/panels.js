// The numbers beside the picture: attitude, clock, counts, refusals, ledger and events. Names from outside are written as text, never
// as HTML.

import { writeFigures } from "./figures.js";
import { NONE, byId, clock, count, degreesMinutes, fixed, hours, make, signed, withUnit, write } from "./format.js";
import { KEPT_EVENTS } from "./protocol.js";

// Rows of names and values that are made once and then only written into.
export class Rows {
  constructor(list) {
    this.list = list;
    this.values = new Map();
  }

  set(name, text, state = "") {
    if (!this.values.has(name)) {
      const value = make("dd", "figure");
      this.list.append(make("dt", "", name), value);
      this.values.set(name, value);
    }
    const value = this.values.get(name);
    write(value, text);
    if (value.dataset.state !== state) value.dataset.state = state;
  }
}

// 0 to 360 degrees, and never 360.0000.
function turn(degrees) {
  const text = fixed(((degrees % 360) + 360) % 360, 4);
  return text === "360.0000" ? "0.0000" : text;
}

export function writeAttitude(attitude, rows) {
  const known = attitude !== null;
  write(byId("ra"), known ? `${turn(attitude.ra_deg)}\u00b0` : NONE);
  write(byId("dec"), known ? `${signed(attitude.dec_deg, 4)}\u00b0` : NONE);
  write(byId("roll"), known ? `${turn(attitude.roll_deg)}\u00b0` : NONE);
  write(byId("ra-hms"), known ? hours(attitude.ra_deg) : "");
  write(byId("dec-dms"), known ? degreesMinutes(attitude.dec_deg) : "");
  const rate = known ? attitude.rate_deg_s : null;
  write(byId("rate"), rate ? `${fixed(Math.hypot(...rate), 3)}\u00a0\u00b0/s` : "");
  writeFigures("pointing", { attitude }, rows);
}

// The verdict on the newest answer: its words, and its colour.
const VERDICTS = { right: ["right", "ok"], wrong: ["wrong", "bad"], invalid: ["no attitude", "warn"], unpaired: ["no sky was shown", "warn"], unjudged: ["not judged", "warn"] };

export function writeTracker(said, rows) {
  const [words, shade] = said.silent ? ["silent", "bad"] : VERDICTS[said.verdict] || ["none yet", "warn"];
  write(byId("tracker-state"), words);
  byId("tracker-state").dataset.state = shade;
  "xyz".split("").forEach((axis, k) => {
    const value = byId(`residual-${axis}`);
    write(value, said.residual_arcsec ? `${signed(said.residual_arcsec[k], 1)}\u2033` : NONE);
    value.dataset.state = said.verdict === "wrong" ? "bad" : "";
  });
  writeFigures("tracker", { tracker: said }, rows);
}

// The newest figure of the focus, for somebody who turns the ring and looks from afar.
export function writeFocus(said, rows) {
  const known = said.sigma_px !== null;
  const judged = said.worse ? ["less sharp", "warn"] : ["sharpest so far", "ok"];
  const [words, shade] = !known ? ["no figure", "warn"] : said.still ? judged : ["it moves", "bad"];
  write(byId("focus-state"), words);
  byId("focus-state").dataset.state = shade;
  write(byId("focus-what"), `by ${said.what}`);
  write(byId("focus-now"), known ? withUnit(said.sigma_px, "px", 3) : NONE);
  write(byId("focus-error"), known ? `\u00b1 ${withUnit(said.error_px, "px", 3)}` : "");
  write(byId("focus-line"), said.line);
  rows.set("Best", said.best_px === null ? NONE : `${withUnit(said.best_px, "px", 3)}, ${fixed(said.best_ago_s)}\u00a0s ago`);
  rows.set("By", known ? `${count(said.count)} ${said.what === "star sigma" ? "widths" : "dots"}` : NONE);
}

// A bar for each reason, as long as its share of all refusals.
export function writeRefusals(refused) {
  const list = byId("refusals");
  const reasons = Object.entries(refused || {}).sort((a, b) => b[1] - a[1]);
  const key = JSON.stringify(reasons);
  if (list.dataset.key === key) return;
  list.dataset.key = key;
  const total = reasons.reduce((sum, [, n]) => sum + n, 0);
  write(byId("refused-total"), total ? count(total) : "");
  if (!total) {
    list.replaceChildren(make("li", "none", "none"));
    return;
  }
  list.replaceChildren(
    ...reasons.map(([reason, n]) => {
      const row = make("li");
      const bar = make("span", "bar");
      bar.style.width = `${Math.max((100 * n) / total, 1)}%`;
      row.append(make("span", "reason", reason), make("span", "figure", count(n)), bar);
      return row;
    }),
  );
}

export function addEvent({ utc, kind, line }, onPick = null, most = KEPT_EVENTS) {
  const list = byId("events");
  const row = make("li");
  const time = make("time", "figure", utc.length > 12 ? clock(utc) : utc);
  const parts = [time, make("span", "chip", kind), make("span", "words", line)];
  row.dataset.kind = kind;
  if (onPick) {
    const button = make("button", "pick");
    button.type = "button";
    button.append(...parts);
    button.addEventListener("click", onPick);
    row.append(button);
  } else row.append(...parts);
  list.prepend(row);
  while (list.childElementCount > most) list.lastElementChild.remove();
  write(byId("events-count"), `${list.childElementCount}`);
}
