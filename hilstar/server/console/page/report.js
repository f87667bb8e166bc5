// The report of a finished run, on the same page: the whole run along its time, and any moment of it.

import { Chart, Histogram, timeText } from "./charts.js";
import { byId, clock, duration, fixed, make, quantity, write } from "./format.js";
import { OVERLAYS, Overlays, pictureText, seenStars } from "./overlays.js";
import { Rows, addEvent, writeAttitude, writeRefusals } from "./panels.js";
import { Picture } from "./picture.js";
import { Sky } from "./sky.js";
import { radecRollOf } from "./sphere.js";
import { ink, startTheme } from "./theme.js";

const PLAY_MS = 900; // duration of each picture
const MIN_SPANS = 24; // shown by a chart at its largest zoom
const FEWEST_S = 0.05;
const FAR_S = 1; // an attitude that is further from the chosen moment is not shown

// Id, title, unit, digits, its curves as [key of the run's spans, words, colour], and its marks, which may be lasting.
const CHARTS = [
  ["chart-age", "Age at light", "ms", 1, [["age", "age", "one"]], [["stale", "stale frames", "warn", true]]],
  ["chart-pacing", "Pacing", "ms", 2, [["interval", "interval", "one"], ["draw", "drawing to swap", "two"]], [["missed", "missed", "bad"]]],
  ["chart-packets", "Packets", "Hz", 1, [], []],
  ["chart-late", "Swap later than predicted", "ms", 2, [["late", "late", "one"]], []],
  ["chart-latency", "Packet to swap", "ms", 1, [["packet", "packet to swap", "one"], ["prediction", "predicted", "two"]], []],
  ["chart-stars", "Stars on the screen", "stars", 0, [["stars", "drawn", "one"], ["clipped", "clipped", "two"], ["below_step", "too faint", "three"]], [["blank", "blank frames", "warn", true]]],
];
const ACTS = /^(operator|mark|fault|scenario|ledger-(begun|ended|started|stopped))/;
const SHADES = ["one", "two", "three"];

let run = null;
let range = [0, 1];
let whole = [0, 1];
let cursor = 0;
let pictureTimer = null;
const charts = {};
const histograms = [];
const picture = new Picture(byId("picture"), () => drawPicture());
const overlays = new Overlays(byId("overlay"), picture.view, onOverlay);
const sky = new Sky(byId("sky"), ink);
const attitudeRows = new Rows(byId("attitude-rows"));

async function unpacked(base64) {
  const bytes = Uint8Array.from(atob(base64), (letter) => letter.charCodeAt(0));
  return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate")));
}

// Charts.

function chart(id, title, unit, note) {
  let figure = byId(id);
  if (!figure) {
    figure = make("figure", "panel chart");
    figure.id = id;
    byId("charts").append(figure);
  }
  charts[id] = new Chart(figure, { title, unit, ink, note, onRange });
  return charts[id];
}

function curves() {
  const found = {};
  const { spans, packets, process, motion, answers } = run;
  for (const [id, , , digits, lines, marks] of CHARTS) {
    found[id] = {
      lines: lines.map(([key, name, shade]) => ({ name, ink: shade, digits, t: spans.t_s, low: spans[key][0], high: spans[key][1] })),
      marks: marks.map(([key, name, shade, lasting]) => ({ name, ink: shade, lasting, t: spans.t_s, n: spans[key] })),
    };
  }
  const line = (name, shade, digits, t, values) => ({ name, ink: shade, digits, t, low: values, high: values });
  found["chart-packets"] = {
    lines: [line("accepted", "one", 1, packets.t_s, packets.accepted_hz)],
    marks: [{ name: "refused", ink: "bad", t: packets.t_s, n: packets.refused_hz.map((hz) => Math.round(hz * packets.width_s)) }],
  };
  if (answers) {
    const [x, y, z] = answers.xyz_arcsec;
    found["chart-residual"] = {
      lines: [line("x", "one", 1, answers.t_s, x), line("y", "two", 1, answers.t_s, y), line("z", "three", 1, answers.t_s, z)],
      marks: [
        { name: "wrong", ink: "bad", t: answers.wrong_s, n: answers.wrong_s.map(() => 1) },
        { name: "fault on", ink: "warn", lasting: true, t: answers.on_s, n: answers.on, count: answers.faults.map((fault) => fault.start_s) },
      ],
    };
  }
  found["chart-memory"] = { lines: [line("resident", "one", 1, process.t_s, process.resident_mb)], marks: [] };
  found["chart-cpu"] = { lines: [line("CPU", "one", 0, process.t_s, process.cpu_percent)], marks: [] };
  for (const [id, part] of [["chart-motion", "about_mean"], ["chart-steady", "beside_steady"]]) {
    if (!motion) continue;
    const digits = motion[part].unit === "arcsec" ? 2 : 4;
    found[id] = { lines: Object.entries(motion[part].curves).map(([name, values], k) => line(name, SHADES[k], digits, motion.t_s, values)), marks: [] };
  }
  return found;
}

// A figure that the run has no value of has no chart.
function makeCharts() {
  const { motion } = run;
  const titles = [
    ...CHARTS,
    ["chart-residual", "Residual of the tracker", "arcsec", "about the camera\u2019s x, y and z; shaded while a fault is on"],
    ["chart-motion", "Motion about the mean", motion?.about_mean.unit, "the camera\u2019s angles less their means over the run"],
    ["chart-steady", "Beside a steady turn", motion?.beside_steady.unit, "how far the camera was from where a constant rate, fitted to the whole run, would have turned it"],
    ["chart-memory", "Memory", "MB"],
    ["chart-cpu", "Processor time", "%"],
  ];
  const all = curves();
  for (const [id, title, unit, note] of titles) {
    if (all[id]?.lines.some(({ high }) => high.some((value) => value !== null))) {
      chart(id, title, unit, typeof note === "string" ? note : "").data = all[id];
      byId(id).hidden = false;
    } else byId(id)?.remove();
  }
  for (const one of run.histograms) {
    const figure = byId("distributions").appendChild(make("figure", "panel chart"));
    const histogram = new Histogram(figure, { title: one.title, unit: "ms", ink });
    histogram.set(one);
    histograms.push(histogram);
  }
  write(byId("distributions-note"), run.stride > 1 ? `of each ${run.stride}th frame; logarithmic` : "of all frames; logarithmic");
}

// What somebody did to the run: operator's controls, marks and faults.
function acts() {
  const times = run.events.filter(({ kind }) => ACTS.test(kind)).map((one) => one.t_s);
  return times.length ? [{ name: "acts", ink: "accent", flag: true, t: times, n: times.map(() => 1) }] : [];
}

function drawCharts() {
  const flags = acts();
  for (const one of Object.values(charts)) {
    one.set(one.data.lines, [...one.data.marks, ...flags], range[0], range[1]);
    one.cursor = cursor;
    one.draw();
  }
  const [from, to] = range.map((at) => timeText(at, 0.1));
  const all = range[0] <= whole[0] && range[1] >= whole[1];
  write(byId("range-text"), all ? `the whole run, ${duration(whole[1] - whole[0])}` : `${from} to ${to}${range[1] <= 90 ? "\u00a0s" : ""}, ${duration(range[1] - range[0])} of ${duration(whole[1])}`);
  for (const id of ["range-whole", "range-out", "range-back", "range-on"]) byId(id).disabled = all;
}

// Within the run, and never so near that nothing is seen.
function onRange({ from, to, pick, whole: all }) {
  if (pick !== undefined) {
    moveTo(pick, true);
    return;
  }
  if (all) range = [...whole];
  else {
    const length = whole[1] - whole[0];
    const least = Math.min(Math.max((length * MIN_SPANS) / Math.max(run.spans.t_s.length, 1), FEWEST_S), length);
    const wide = Math.min(Math.max(to - from, least), length);
    const begin = Math.min(Math.max((from + to - wide) / 2, whole[0]), whole[1] - wide);
    range = [begin, begin + wide];
  }
  drawCharts();
}

function rangeBy(act) {
  const [from, to] = range;
  const about = cursor > from && cursor < to ? cursor : (from + to) / 2;
  const scaled = (factor) => ({ from: about - (about - from) * factor, to: about + (to - about) * factor });
  const shifted = (share) => ({ from: from + share * (to - from), to: to + share * (to - from) });
  onRange({ in: scaled(0.5), out: scaled(2), back: shifted(-0.5), on: shifted(0.5), whole: { whole: true } }[act]);
}

// A moment of the run: the numbers, the map, and the nearest picture.

function nearest(times, at) {
  let best = -1;
  times.forEach((t, k) => {
    if (best < 0 || Math.abs(t - at) < Math.abs(times[best] - at)) best = k;
  });
  return best;
}

function moveTo(at, withPicture) {
  cursor = Math.min(Math.max(at, whole[0]), whole[1]);
  const { path } = run;
  const k = nearest(path.t_s, cursor);
  const q = k < 0 ? null : path.q[k];
  const [ra, dec, roll] = q ? radecRollOf(q) : [];
  const rate = q ? path.rate_deg_s.map((axis) => axis[k]) : [];
  writeAttitude(q && { q, ra_deg: ra, dec_deg: dec, roll_deg: roll, rate_deg_s: rate.includes(null) ? null : rate }, attitudeRows);
  const far = q && Math.abs(path.t_s[k] - cursor) > FAR_S;
  write(byId("attitude-state"), q ? `${far ? "none then; " : ""}at ${momentText(path.t_s[k])}` : "none in this run");
  byId("attitude-state").dataset.state = far ? "warn" : "";
  attitudeRows.set("UTC", run.about.started_utc ? clock(Date.parse(run.about.started_utc) + 1000 * cursor, 3) : "\u2013");
  sky.q = q;
  const near = q ? sky.nearest(q) : "";
  write(byId("sky-near"), near ? `near ${near}` : "");
  byId("sky").setAttribute("aria-label", q ? `Whole sky with the run's track: boresight at RA ${ra.toFixed(1)}, Dec ${dec.toFixed(1)} degrees` : "Whole sky: no attitude");
  sky.draw();
  if (withPicture && run.pictures.length) show(nearest(run.pictures.map((one) => one.t_s), cursor), false);
  drawCharts();
}

function momentText(t) {
  return `${timeText(Math.abs(t) < 0.05 ? 0 : t, 0.1)}${Math.abs(t) <= 90 ? "\u00a0s" : ""}`;
}

async function show(k, andMove = true) {
  const one = run.pictures[k];
  byId("scrub").value = String(k);
  if (!one.levels) {
    const raw = await (await unpacked(one.data)).arrayBuffer();
    one.levels = one.dtype === "u2" ? new Uint16Array(raw) : new Uint8Array(raw);
  }
  picture.show(one.levels, one.w, one.h, one.frame);
  overlays.truths.clear();
  overlays.newest = null;
  if (one.truth) overlays.add({ ...one.truth, frame: one.frame });
  picture.follow(overlays.of(one.frame));
  write(byId("scrub-text"), [momentText(one.t_s), `picture ${k + 1} of ${run.pictures.length}`, one.why].filter(Boolean).join(" \u00b7 "));
  byId("scrub").setAttribute("aria-valuetext", byId("scrub-text").textContent);
  const badge = byId("picture-badge");
  badge.hidden = !(one.stale || !one.truth);
  write(badge, one.truth ? "Stale attitude" : one.operator ? "Blank" : "No attitude");
  const acts = byId("picture-operator");
  acts.hidden = !one.operator;
  write(acts, one.operator ? `By the operator, not drawn here: ${one.operator}` : "");
  drawPicture();
  if (andMove) moveTo(one.t_s, false);
}

function drawPicture() {
  if (!picture.levels) return;
  picture.draw();
  overlays.draw(picture);
  const zoom = Math.round((100 * picture.view.scale) / picture.view.ratio);
  const truth = overlays.of(picture.frame);
  write(byId("picture-text"), pictureText(truth, picture, zoom));
  const named = seenStars(truth, picture).slice(0, 3);
  byId("picture").setAttribute("aria-label", `Frame ${picture.frame} of the run${named.length ? `, brightest ${named.join(", ")}` : ""}`);
}

function onOverlay(key) {
  if (key === "clipped") picture.setRedClipped(overlays.on.clipped);
  drawPicture();
}

function play() {
  const button = byId("play");
  const on = pictureTimer === null;
  button.setAttribute("aria-pressed", String(on));
  write(button, on ? "Stop" : "Play");
  if (!on) {
    clearInterval(pictureTimer);
    pictureTimer = null;
    return;
  }
  pictureTimer = setInterval(() => show((Number(byId("scrub").value) + 1) % run.pictures.length), PLAY_MS);
}

// Words.

function capital(text) {
  return text.charAt(0).toUpperCase() + text.slice(1);
}

function writeHealth({ ok, late, headline, share, reasons }) {
  const box = byId("health");
  box.dataset.ok = document.body.dataset.ok = String(ok);
  box.dataset.late = document.body.dataset.late = String(late);
  write(byId("health-icon"), ok ? "\u2713" : "!");
  write(byId("health-headline"), headline);
  write(byId("health-reasons"), ok ? "every frame on time, with a fresh attitude" : `${share} of its time was: ${reasons.join("; ")}`);
  write(byId("health-since"), run.about.started_utc ? `${run.about.started_utc.slice(0, 19).replace("T", " ")} UTC` : "");
  write(byId("health-for"), duration(run.duration_s));
}

function writeFacts() {
  const { about, summary, facts } = run;
  document.title = `${run.verdict.ok ? "\u2713" : "\u2717"} ${about.run}: hilstar`;
  write(byId("bench"), about.run);
  const rows = new Rows(byId("summary"));
  for (const [name, text] of summary) rows.set(capital(name), text);
  const runRows = new Rows(byId("run-rows"));
  write(byId("run-head"), about.refresh_hz ? `${about.refresh_hz}\u00a0Hz  ${about.bits}\u00a0bit` : "");
  const size = about.resolution_px ? `${about.resolution_px[0]} \u00d7 ${about.resolution_px[1]}\u00a0px` : "\u2013";
  for (const [name, text] of [["Ledger", about.run], ["Bench", about.bench], ["Screen", size], ...facts, ["Report by", `hilstar ${about.version}`]]) runRows.set(capital(name), text);
  write(byId("bench-text"), run.bench_text);
  byId("bench-details").hidden = !run.bench_text;
  writeRefusals(run.refused);
}

// A row for each fault: what it did to the tracker's answers.
function writeFaultEffects() {
  const faults = run.answers?.faults || [];
  byId("fault-effects").hidden = !faults.length;
  const row = (cells, name) => {
    const line = make("tr");
    line.append(...cells.map((text) => make(name, "", text)));
    return line;
  };
  const percent = (share) => (share === null ? "\u2013" : `${fixed(100 * share, 1)}\u00a0%`);
  const parts = (fault, pick) => ["before", "during", "after"].map((part) => pick(fault[part])).join(" / ");
  const cells = (fault) => [
    fault.name,
    `${momentText(fault.start_s)} to ${fault.end_s === null ? "the end" : momentText(fault.end_s)}`,
    parts(fault, (span) => percent(span.availability)),
    parts(fault, (span) => (span.rms_arcsec ? span.rms_arcsec.map((value) => fixed(value, 1)).join(" ") : "\u2013")),
    String(fault.during.wrong + fault.after.wrong),
    fault.first_wrong_s === null ? "none" : quantity(fault.first_wrong_s, "s", 2),
    fault.recovered_s === null ? "not" : quantity(fault.recovered_s, "s", 2),
  ];
  const head = ["Fault", "On", "Availability", "Rms x y z, arcsec", "Wrong", "First wrong after", "Recovered in"];
  byId("fault-table").replaceChildren(row(head, "th"), ...faults.map((fault) => row(cells(fault), "td")));
}

function writeEvents() {
  for (const { t_s: at, utc, kind, line } of run.events) addEvent({ utc: utc || momentText(at), kind, line }, () => moveTo(at, true), run.events.length);
  byId("range-acts").hidden = !acts().length;
  const left = run.events_total - run.events.length;
  write(byId("events-count"), left > 0 ? `${run.events_total}, the first and last ${run.events.length}` : `${run.events_total}`);
  if (!run.events.length) byId("events").append(make("li", "none", "none"));
}

function startPicture() {
  const { pictures, about } = run;
  byId("picture-foot").hidden = byId("overlays").hidden = byId("stage").hidden = !pictures.length;
  document.querySelector(".scrub").hidden = pictures.length < 2;
  const none = byId("no-picture");
  none.hidden = pictures.length > 0 && !run.caution;
  none.dataset.state = pictures.length ? "warn" : "";
  write(none, pictures.length ? `\u25b2 ${run.caution}` : `No pictures: ${run.no_pictures || "no frame could be drawn"}.`);
  if (!pictures.length) return;
  picture.setScreen(about.resolution_px, run.white_level);
  overlays.makeButtons(byId("overlays"));
  overlays.buttons.answer.hidden = true; // the pictures of a report have no marks of answers
  picture.setRedClipped(overlays.on.clipped);
  byId("scrub").max = String(pictures.length - 1);
}

const KEYS = {
  0: () => picture.view.fit(),
  1: () => picture.view.setZoom(1),
  9: () => picture.showPixels(overlays.of(picture.frame)),
  "+": () => picture.view.zoomStep(1),
  "-": () => picture.view.zoomStep(-1),
  ArrowLeft: () => picture.view.pan(-1, 0),
  ArrowRight: () => picture.view.pan(1, 0),
  ArrowUp: () => picture.view.pan(0, -1),
  ArrowDown: () => picture.view.pan(0, 1),
};

function onKey(event) {
  if (event.ctrlKey || event.metaKey || event.altKey || event.target.closest("input, select, textarea, .ranged")) return;
  const overlay = OVERLAYS.find(([, , , stroke]) => stroke === event.key);
  if (overlay) overlays.toggle(overlay[0]);
  else if (KEYS[event.key] && (!event.key.startsWith("Arrow") || document.activeElement === byId("picture"))) KEYS[event.key]();
  else return;
  event.preventDefault();
}

function listen() {
  const zooms = { "zoom-fit": 0, "zoom-one": 1, "zoom-pixels": 9, "zoom-in": "+", "zoom-out": "-" };
  for (const [id, key] of Object.entries(zooms)) byId(id).addEventListener("click", KEYS[key]);
  for (const act of ["whole", "in", "out", "back", "on"]) byId(`range-${act}`).addEventListener("click", () => rangeBy(act));
  byId("stretch").addEventListener("change", (event) => {
    picture.setStretch(event.target.value);
    drawPicture();
  });
  byId("scrub").addEventListener("input", (event) => show(Number(event.target.value)));
  byId("play").addEventListener("click", play);
  for (const kind of ["pointermove", "pointerdown", "pointerleave"]) byId("picture").addEventListener(kind, () => overlays.draw(picture));
  document.addEventListener("keydown", onKey);
  new ResizeObserver(() => picture.fitStage() && drawPicture()).observe(byId("stage"));
  new ResizeObserver(drawAll).observe(byId("main"));
}

function drawAll() {
  drawPicture();
  drawThemed();
}

function drawThemed() {
  sky.draw();
  drawCharts();
  for (const one of histograms) one.draw();
}

async function start() {
  run = await (await unpacked(byId("run-data").textContent)).json();
  whole = [0, Math.max(run.duration_s, FEWEST_S)];
  range = [...whole];
  writeHealth(run.verdict);
  writeFacts();
  writeEvents();
  writeFaultEffects();
  startPicture();
  if (run.sky) sky.setSky(run.sky);
  sky.trail = run.path.q.map((q) => radecRollOf(q).slice(0, 2));
  makeCharts();
  startTheme(drawAll, drawThemed);
  listen();
  const lit = run.pictures.findIndex((one) => one.truth);
  if (run.pictures.length) await show(Math.max(lit, 0));
  else moveTo(0, false);
  document.body.dataset.ready = "true";
}

start();
