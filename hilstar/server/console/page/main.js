// The operator's page: passes the messages of the link to the picture, the map, the charts, the numbers and the health.

import { Chart, timesOf } from "./charts.js";
import { Controls, listKeys } from "./controls.js";
import { nameStars, writeFigures } from "./figures.js";
import { byId, clock, duration, write } from "./format.js";
import { Health } from "./health.js";
import { Link } from "./link.js";
import { OVERLAYS, Overlays, pictureText, seenStars } from "./overlays.js";
import { Rows, addEvent, writeAttitude, writeFocus, writeRefusals, writeTracker } from "./panels.js";
import { Picture } from "./picture.js";
import { HISTORY_S, MESSAGE_KEYS } from "./protocol.js";
import { Sky } from "./sky.js";
import { ink, startTheme } from "./theme.js";

const PICTURE_HZ = 8;
const CALM_HZ = 2; // pictures a second if the system is set to reduced motion
const OLD_PICTURE_MS = 700;
const SKY_MS = 250;
const TRAIL_DEG = 0.05; // the boresight's track gets a point after each motion of this angle

let hello = null;
let state = null;
let points = [];
let trail = [];
let held = false;
let pictureAt = -Infinity;
let decoding = false;
const dirty = { picture: false, overlay: false, sky: false, charts: false };

const picture = new Picture(byId("picture"), () => redraw("picture"));
const overlays = new Overlays(byId("overlay"), picture.view, onOverlay);
const sky = new Sky(byId("sky"), ink);
const link = new Link({ onMessage, onPicture, onChange });
const health = new Health(link, () => redraw("picture"));
const controls = new Controls(link);
const attitudeRows = new Rows(byId("attitude-rows"));
const runRows = new Rows(byId("run-rows"));
const trackerRows = new Rows(byId("tracker-rows"));
const focusRows = new Rows(byId("focus-rows"));
const charts = {
  age: new Chart(byId("chart-age"), { title: "Age of the attitude", unit: "ms", ink }),
  pacing: new Chart(byId("chart-pacing"), { title: "Pacing", unit: "ms", ink }),
  packets: new Chart(byId("chart-packets"), { title: "Packets", unit: "Hz", ink }),
  residual: new Chart(byId("chart-residual"), { title: "Residual of the tracker", unit: "arcsec", ink }),
  focus: new Chart(byId("chart-focus"), { title: "Last minute", unit: "px", ink }),
};

function redraw(what) {
  if (!Object.values(dirty).some(Boolean)) requestAnimationFrame(drawAll);
  dirty[what] = true;
}

function drawAll() {
  if (dirty.picture) {
    picture.draw();
    tellPicture();
  }
  if (dirty.picture || dirty.overlay) overlays.draw(picture);
  if (dirty.sky) sky.draw();
  if (dirty.charts) drawCharts();
  for (const what of Object.keys(dirty)) dirty[what] = false;
}

function drawThemed() {
  sky.draw();
  drawCharts();
}

function onChange() {
  health.check();
  if (!link.open) controls.lose();
}

const HEARD = {
  hello(said) {
    hello = said;
    picture.setScreen(said.resolution_px, said.white_level);
    controls.setUp(said);
    health.bench = said.bench;
    document.body.dataset.session = String(Boolean(said.session));
    document.body.dataset.control = String(said.control);
    document.body.dataset.answers = String(said.answers);
    byId("tracker").hidden = byId("chart-residual").hidden = !said.answers;
    overlays.buttons.answer.hidden = !said.answers;
    picture.setRedClipped(overlays.on.clipped && !said.session); // a pattern's white pixels are intended
    health.session = Boolean(said.session);
    write(byId("bench"), said.bench);
    byId("bench").title = said.bench;
    write(byId("run-head"), `${said.command}  ${said.refresh_hz ? `${said.refresh_hz} Hz  ` : ""}${said.bits} bit${said.certificate ? `  certificate ${said.certificate}` : ""}`);
    byId("run-head").title = `hilstar ${said.version}, ${said.renderer}, started ${said.started_utc}`;
    byId("events").replaceChildren();
    points = [];
    trail = [];
    askForPictures();
    loadSky();
  },
  state(said) {
    state = said;
    health.hear(said);
    write(byId("utc"), `${clock(said.utc)} UTC`);
    writeAttitude(said.attitude, attitudeRows);
    writeFigures("source", said, attitudeRows);
    writeFigures("run", said, runRows);
    writeRefusals(said.counts.refused);
    if (said.tracker) writeTracker(said.tracker, trackerRows);
    byId("focus").hidden = !said.focus;
    if (said.focus) writeFocus(said.focus, focusRows);
    controls.hear(said);
    tellFrame(said);
    moveSky(said.attitude);
  },
  history(said) {
    points = said;
    redraw("charts");
  },
  point(said) {
    points.push(said);
    const from = said.t_s - (hello?.history_s || HISTORY_S);
    while (points.length && points[0].t_s < from) points.shift();
    redraw("charts");
  },
  event(said) {
    const newest = byId("events").firstElementChild;
    if (said.kind === "pattern" && newest?.dataset.kind === "pattern") newest.remove(); // a step keeps one line for all its patterns
    addEvent(said);
  },
  answer(said) {
    writeTracker(said, trackerRows);
  },
  truth(said) {
    if (held && said.frame !== picture.frame) return; // a held picture keeps the marks of its own frame
    overlays.add(said);
    nameStars(said.stars);
    redraw("picture");
  },
};

function onMessage(message) {
  for (const key of MESSAGE_KEYS) if (key in message) HEARD[key](message[key]);
}

// A picture that comes while the one before is still being unpacked is dropped: the page never falls behind.
async function onPicture(data) {
  if (held || decoding) return;
  decoding = true;
  try {
    const length = new DataView(data).getUint32(0, true);
    const head = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, length)));
    const body = new Blob([new Uint8Array(data, 4 + length)]);
    const stream = head.deflate ? body.stream().pipeThrough(new DecompressionStream("deflate")) : body.stream();
    const raw = await new Response(stream).arrayBuffer();
    if (held) return;
    picture.show(head.dtype === "u2" ? new Uint16Array(raw) : new Uint8Array(raw), head.w, head.h, head.frame);
    picture.follow(overlays.of(head.frame));
    pictureAt = performance.now();
    redraw("picture");
  } finally {
    decoding = false;
  }
}

function askForPictures() {
  const calm = matchMedia("(prefers-reduced-motion: reduce)").matches;
  link.ask({ picture: !document.hidden, hz: calm ? CALM_HZ : PICTURE_HZ, grid: overlays.on.grid });
}

async function loadSky() {
  const answer = await link.get("/sky");
  if (answer.ok) {
    sky.setSky(await answer.json());
    redraw("sky");
  }
}

let skyAt = -Infinity;
function moveSky(attitude) {
  sky.q = attitude ? attitude.q : null;
  if (attitude) {
    const last = trail[trail.length - 1];
    const moved = !last || Math.hypot(last[0] - attitude.ra_deg, last[1] - attitude.dec_deg) > TRAIL_DEG;
    if (moved) trail.push([attitude.ra_deg, attitude.dec_deg]);
    while (trail.length > 600) trail.shift();
  }
  sky.trail = trail;
  if (performance.now() - skyAt < SKY_MS) return;
  skyAt = performance.now();
  const near = attitude ? sky.nearest(attitude.q) : "";
  write(byId("sky-near"), near ? `near ${near}` : "");
  const words = attitude ? `boresight at RA ${attitude.ra_deg.toFixed(1)}, Dec ${attitude.dec_deg.toFixed(1)} degrees${near ? `, near ${near}` : ""}` : "no attitude";
  byId("sky").setAttribute("aria-label", `Whole sky: ${words}`);
  redraw("sky");
}

function column(key, scale = 1) {
  return points.map((point) => (point[key] === null || point[key] === undefined ? null : point[key] * scale));
}

function series(name, key, shade, digits) {
  const values = column(key);
  return { name, ink: shade, digits, t: timesOf(points), low: values, high: values };
}

function drawCharts() {
  const span = -(hello?.history_s || HISTORY_S);
  const t = timesOf(points);
  health.lately = column("missed").reduce((sum, n) => sum + (n || 0), 0);
  charts.age.set([series("age", "age_ms", "one", 1)], [], span, 0);
  charts.pacing.set([series("interval", "interval_ms", "one", 2), series("drawing", "frame_ms", "two", 2)], [{ name: "missed", ink: "bad", t, n: column("missed") }], span, 0);
  charts.packets.set([series("packets", "packets_hz", "one", 1)], [{ name: "refused", ink: "bad", t, n: column("refused") }], span, 0);
  const axes = ["x", "y", "z"].map((axis, k) => series(axis, `${axis}_arcsec`, ["one", "two", "three"][k], 1));
  charts.residual.set(axes, [{ name: "wrong", ink: "bad", t, n: column("wrong") }], span, 0);
  charts.focus.set([series("width", "focus_px", "one", 3)], [], span, 0);
  for (const chart of Object.values(charts)) chart.draw();
}

const FRAME_STATES = [
  ["missing", "no attitude", "bad"],
  ["stale", "stale", "bad"],
  ["blank", "blank", "warn"],
];

function tellFrame({ frame, operator }) {
  const [, words, shade] = FRAME_STATES.find(([key]) => frame[key]) || ["", hello?.session ? hello.command.replace("hilstar ", "") : "fresh", "ok"];
  const chip = byId("attitude-state");
  write(chip, words);
  chip.dataset.state = shade;
  const acts = Object.entries(operator || {}).filter(([, on]) => on).map(([name]) => name);
  const badge = byId("picture-operator");
  badge.hidden = !acts.length;
  write(badge, acts.length ? `By the operator: ${acts.join(", ")}` : "");
  tellAge();
}

// The picture itself says when it is old: held on this page, or because none came.
function tellAge() {
  const badge = byId("picture-badge");
  const age = performance.now() - pictureAt;
  const calm = matchMedia("(prefers-reduced-motion: reduce)").matches;
  const old = !hello?.session && picture.levels && age > OLD_PICTURE_MS * (calm ? 2 : 1);
  badge.hidden = !(held || old);
  badge.dataset.state = held ? "held" : "old";
  write(badge, held ? `Held on this page: frame ${picture.frame}` : old ? `This picture is ${duration(age / 1000)} old` : "");
}

function tellPicture() {
  const zoom = Math.round((100 * picture.view.scale) / picture.view.ratio);
  const truth = overlays.of(picture.frame);
  write(byId("picture-text"), picture.frame === null ? "" : pictureText(truth, picture, zoom));
  const named = seenStars(truth, picture).slice(0, 3);
  const words = picture.frame === null ? "no picture yet" : `frame ${picture.frame}, ${state?.frame.stars ?? "?"} stars${named.length ? `, brightest ${named.join(", ")}` : ""}`;
  byId("picture").setAttribute("aria-label", `What the monitor shows: ${words}`);
}

function onOverlay(key) {
  if (key === "grid") askForPictures();
  if (key === "clipped") picture.setRedClipped(overlays.on.clipped);
  redraw("picture");
}

function hold() {
  held = !held;
  byId("hold").setAttribute("aria-pressed", String(held));
  tellAge();
}

const KEYS = [
  ...OVERLAYS.map(([key, words, , stroke]) => [stroke, `${words}, on or off`, () => overlays.toggle(key)]),
  ["0", "Whole picture", () => picture.view.fit()],
  ["1", "One to one", () => picture.view.setZoom(1)],
  ["9", "Single pixels at the brightest star, which is followed", () => picture.showPixels(overlays.of(picture.frame))],
  ["+", "Zoom in", () => picture.view.zoomStep(1)],
  ["-", "Zoom out", () => picture.view.zoomStep(-1)],
  ["h", "Hold the picture on this page", hold],
  ["B", "Blank the monitor (twice)", () => controls.press("blank")],
  ["P", "Pause", () => controls.press("pause")],
  ["K", "Mark: write its text", () => byId("mark-text").focus()],
  ["?", "These keys", () => byId("shortcuts").showModal()],
];
const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };

function onKey(event) {
  if (event.ctrlKey || event.metaKey || event.altKey || byId("shortcuts").open) return;
  if (event.target.closest("input, select, textarea")) return;
  if (event.key in ARROWS && document.activeElement === byId("picture")) picture.view.pan(...ARROWS[event.key]);
  else {
    const found = byId("shortcuts-on").checked || event.key === "?" ? KEYS.find(([key]) => key === event.key) : null;
    if (!found) return;
    found[2]();
  }
  event.preventDefault();
}

function start() {
  overlays.makeButtons(byId("overlays"));
  picture.setRedClipped(overlays.on.clipped);
  startTheme(() => Object.keys(dirty).forEach(redraw), drawThemed);
  listKeys([...KEYS.map(([key, words]) => [key === key.toUpperCase() && /[A-Z]/.test(key) ? `Shift ${key}` : key.toUpperCase(), words]), ["Arrows", "Move the picture, when it has the focus"]]);
  const act = { "zoom-fit": "0", "zoom-one": "1", "zoom-pixels": "9", "zoom-in": "+", "zoom-out": "-", hold: "h", "shortcuts-open": "?" };
  for (const [id, key] of Object.entries(act)) byId(id).addEventListener("click", KEYS.find(([k]) => k === key)[2]);
  byId("stretch").addEventListener("change", (event) => {
    picture.setStretch(event.target.value);
    redraw("picture");
  });
  for (const kind of ["pointermove", "pointerdown", "pointerleave"]) byId("picture").addEventListener(kind, () => redraw("overlay"));
  document.addEventListener("keydown", onKey);
  document.addEventListener("visibilitychange", askForPictures);
  new ResizeObserver(() => picture.fitStage() && redraw("picture")).observe(byId("stage"));
  new ResizeObserver(() => Object.keys(dirty).forEach(redraw)).observe(byId("main"));
  setInterval(tellAge, 200);
  controls.setUp({ control: false, faults: [] });
  writeRefusals({});
  link.connect();
}

start();
