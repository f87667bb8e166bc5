// The numbers beside the picture: attitude, clock, counts, refusals, ledger and events. Names from outside are only ever text.

import { NONE, byId, bytes, clock, count, degreesMinutes, fixed, hours, make, quantity, signed, withUnit, write } from "./format.js";
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
  rows.set("Rate x, y, z", rate ? `${rate.map((part) => signed(part, 3)).join("  ")}\u00a0\u00b0/s` : NONE);
  rows.set("Quaternion", known ? attitude.q.map((part) => signed(part, 5)).join("  ") : NONE);
}

export function writeSource(state, rows) {
  const { attitude, source, clock: sender } = state;
  rows.set("First attitude", state.pointing || NONE);
  rows.set("Age at light", attitude ? quantity(attitude.age_ms, "ms", 1) : NONE);
  rows.set("Source", source ? [source.kind, source.endpoint].filter(Boolean).join("  ") : NONE);
  rows.set("Clock offset", sender ? `${quantity(sender.offset_ms, "ms", 3)} \u00b1 ${quantity(sender.sigma_ms, "ms", 3)}` : NONE);
  rows.set("Clock drift", sender ? withUnit(sender.drift_ppm, "ppm", 2) : NONE);
  rows.set("Clock from", sender ? (sender.synchronised ? "time exchange" : "arrivals (excludes the minimum delay)") : NONE);
}

export function writeRun({ frame, counts, pacing, ledger }, rows) {
  const seen = (value) => (value ? "warn" : "");
  rows.set("Frames", count(counts.frames));
  rows.set("Missed", count(counts.missed), seen(counts.missed));
  rows.set("Stale", count(counts.stale), seen(counts.stale));
  rows.set("Given up", count(counts.given_up), seen(counts.given_up));
  rows.set("Packets", `${count(counts.accepted)} of ${count(counts.received)} accepted`);
  rows.set("Lost", count(counts.lost ?? 0), seen(counts.lost));
  rows.set("Interval p50, p99", pacing ? `${quantity(pacing.p50_ms, "ms", 2)}, ${quantity(pacing.p99_ms, "ms", 2)}` : NONE);
  rows.set("Jitter (sd)", pacing ? quantity(pacing.sd_ms, "ms", 3) : NONE);
  rows.set("Stars drawn", count(frame.stars));
  const clipped = frame.clipped || [];
  rows.set("Clipped", clipped.length ? `${clipped.length}: ${clipped.slice(0, 4).join(", ")}${clipped.length > 4 ? ", \u2026" : ""}` : "none", clipped.length ? "warn" : "");
  if (ledger === null) rows.set("Ledger", "not written", "warn");
  else rows.set("Ledger", ledger.failing ? `FAILING: ${ledger.failing}` : `${ledger.path}  ${bytes(ledger.bytes)}`, ledger.failing ? "bad" : "");
}

// The verdict on the newest answer: its words, and its colour.
const VERDICTS = { right: ["right", "ok"], wrong: ["wrong", "bad"], invalid: ["no attitude", "warn"], unpaired: ["no sky was shown", "warn"], unjudged: ["not judged", "warn"] };

export function three(values) {
  return values ? values.map((value) => signed(value, 1)).join("  ") : NONE;
}

export function writeTracker(said, rows) {
  const [words, shade] = said.silent ? ["silent", "bad"] : VERDICTS[said.verdict] || ["none yet", "warn"];
  write(byId("tracker-state"), words);
  byId("tracker-state").dataset.state = shade;
  "xyz".split("").forEach((axis, k) => {
    const value = byId(`residual-${axis}`);
    write(value, said.residual_arcsec ? `${signed(said.residual_arcsec[k], 1)}\u2033` : NONE);
    value.dataset.state = said.verdict === "wrong" ? "bad" : "";
  });
  rows.set("Mean, last minute", `${three(said.mean_arcsec)}\u2033`);
  rows.set("Rms", `${three(said.rms_arcsec)}\u2033`);
  rows.set("3 sigma", `${three(said.sigma3_arcsec)}\u2033`);
  rows.set("Availability", said.availability === null ? NONE : `${fixed(100 * said.availability, 1)}\u00a0% at ${fixed(said.rate_hz, 1)}\u00a0Hz`);
  rows.set("Latency", said.latency_ms === null ? NONE : `${quantity(said.latency_ms, "ms", 0)} \u00b1 ${quantity(said.latency_sigma_ms, "ms", 1)}`);
  rows.set("Mode", said.mode || NONE);
  rows.set("Stars", said.stars === null ? NONE : count(said.stars));
  rows.set("Answers", `${count(said.answers)}, ${count(said.invalid)} without attitude`);
  rows.set("Wrong", count(said.wrong), said.wrong ? "bad" : "");
  const refused = Object.entries(said.refused).map(([reason, n]) => `${n} ${reason}`);
  rows.set("Refused", refused.join(", ") || "none", refused.length ? "warn" : "");
  rows.set("Out of order", count(said.out_of_order), said.out_of_order ? "warn" : "");
  rows.set("Line", said.trouble || "in order", said.trouble ? "warn" : "");
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
