// The marks over the picture: stars, boresight, outline and grid of the same frame, computed from the bench's stars and lens.

import { make } from "./format.js";
import { STAR } from "./protocol.js";

// Key, words on the button, on at first, and the key on the keyboard.
export const OVERLAYS = [
  ["names", "Names", true, "n"],
  ["magnitudes", "Magnitudes", false, "m"],
  ["truth", "Truth", false, "t"],
  ["boresight", "Boresight", true, "x"],
  ["grid", "RA/Dec grid", false, "g"],
  ["tracker", "Tracker field", true, "f"],
  ["clipped", "Clipped", true, "c"],
  ["answer", "Answer", true, "a"],
];
const INK = { truth: "#63d2a1", name: "#c9d6ee", grid: "rgba(110, 150, 225, 0.6)", tracker: "#ffcf70", boresight: "#7db4ff", clipped: "#ff6b6b", answer: "#f08bd8" };
const LABELS = 40; // of the brightest stars in view; more labels would hide the stars
const FAINTEST_RING_MAG = 8;
const KEPT_TRUTHS = 12;
const UNDER_CODES = 0.6; // opacity of lines over pixels with code values
const LABEL_AREA_PX = 24000; // visible area of the picture, in CSS pixels squared, per label
const POINTED_PX = 12; // largest distance from the pointer to the star that it names

export class Overlays {
  constructor(canvas, view, onChange) {
    Object.assign(this, { canvas, view, on: {}, truths: new Map(), newest: null });
    this.context = canvas.getContext("2d");
    this.buttons = {};
    for (const [key, , initially] of OVERLAYS) this.on[key] = initially;
    this.onChange = onChange;
  }

  makeButtons(group) {
    for (const [key, words, , stroke] of OVERLAYS) {
      const button = make("button", "", words);
      button.type = "button";
      button.id = `overlay-${key}`;
      button.title = `${words} (${stroke.toUpperCase()})`;
      button.setAttribute("aria-pressed", String(this.on[key]));
      button.addEventListener("click", () => this.toggle(key));
      this.buttons[key] = button;
      group.append(button);
    }
  }

  toggle(key) {
    this.on[key] = !this.on[key];
    this.buttons[key]?.setAttribute("aria-pressed", String(this.on[key]));
    this.onChange(key);
  }

  add(truth) {
    this.truths.set(truth.frame, truth);
    this.newest = truth;
    while (this.truths.size > KEPT_TRUTHS) this.truths.delete(this.truths.keys().next().value);
  }

  // The marks of the picture's frame, or the newest ones while those of the frame have not come.
  of(frame) {
    return this.truths.get(frame) || this.newest;
  }

  draw(picture) {
    const { canvas, context, view } = this;
    canvas.width = view.canvas.width;
    canvas.height = view.canvas.height;
    const truth = this.of(picture.frame);
    this.labels = 0;
    if (picture.hasValues) context.globalAlpha = UNDER_CODES;
    if (truth) this.drawTruth(truth, picture);
    context.globalAlpha = 1;
    if (picture.hasValues) picture.drawValues(context);
    canvas.dataset.labels = String(this.labels);
  }

  drawTruth(truth, picture) {
    const { context, view } = this;
    this.picture = picture;
    const stars = truth.stars || [];
    context.lineJoin = "round";
    this.unit = view.ratio;
    this.taken = [];
    this.outline = this.on.tracker && (truth.tracker_px || []).length > 2 ? truth.tracker_px.map(([x, y]) => view.toCanvas(x, y)) : [];
    if (this.on.grid) this.drawGrid(truth.grid || []);
    if (this.on.tracker) this.drawTracker();
    if (this.on.answer) this.drawAnswer(truth);
    if (this.on.truth || this.on.clipped) this.drawRings(stars);
    if (this.on.boresight && truth.boresight_px) this.drawBoresight(truth.boresight_px);
    if (picture.hasValues) return; // labels would hide the codes: the names are below the picture instead
    if (this.on.names || this.on.magnitudes) this.drawLabels(stars);
    this.drawPointed(stars, picture.pointer);
  }

  path(points, close) {
    this.context.beginPath();
    points.forEach(([x, y], k) => this.context[k ? "lineTo" : "moveTo"](...this.view.toCanvas(x, y)));
    if (close) this.context.closePath();
  }

  inside([u, v], margin = 0) {
    return u >= -margin && v >= -margin && u <= this.canvas.width + margin && v <= this.canvas.height + margin;
  }

  write(text, u, v, colour, size = 12) {
    const { context, unit } = this;
    context.font = `${size * unit}px system-ui, sans-serif`;
    context.textAlign = "left";
    context.textBaseline = "middle";
    context.lineWidth = 3 * unit;
    context.strokeStyle = "rgba(0, 0, 0, 0.8)";
    context.strokeText(text, u, v);
    context.fillStyle = colour;
    context.fillText(text, u, v);
  }

  drawGrid(lines) {
    const { context, unit } = this;
    for (const { label, px } of lines) {
      context.strokeStyle = INK.grid;
      context.lineWidth = unit;
      this.path(px, false);
      context.stroke();
      const at = px.map(([x, y]) => this.view.toCanvas(x, y)).find((place) => this.inside(place, -14 * unit));
      if (!label || !at || this.picture.hasValues) continue;
      context.font = `${11 * unit}px system-ui, sans-serif`;
      const left = Math.min(at[0] + 4 * unit, this.canvas.width - context.measureText(label).width - 6 * unit);
      if (this.place(label, left, at[1], 11)) this.write(label, left, at[1] - (left < at[0] ? 8 * unit : 0), "#9dbcf5", 11);
    }
  }

  drawTracker() {
    const { context, unit, outline } = this;
    if (!outline.length) return;
    context.strokeStyle = INK.tracker;
    context.lineWidth = 1.5 * unit;
    context.setLineDash([8 * unit, 5 * unit]);
    context.beginPath();
    outline.forEach((at, k) => context[k ? "lineTo" : "moveTo"](...at));
    context.closePath();
    context.stroke();
    context.setLineDash([]);
    if (this.picture.hasValues) return;
    const inside = outline.filter((place) => this.inside(place, -6 * unit));
    const top = inside.reduce((best, place) => (best && best[0] + best[1] <= place[0] + place[1] ? best : place), null);
    const label = "tracker\u2019s field";
    if (top && this.place(label, top[0] + 6 * unit, top[1] + 12 * unit, 11)) this.write(label, top[0] + 6 * unit, top[1] + 12 * unit, INK.tracker, 11);
  }

  // The tracker's newest answer: the outline of the field that it reports, and a diamond about each reported centroid.
  drawAnswer({ reported_px: field, centroids_px: places }) {
    const { context, unit, view } = this;
    context.strokeStyle = INK.answer;
    context.lineWidth = 1.5 * unit;
    if ((field || []).length > 2) {
      this.path(field, true);
      context.stroke();
    }
    for (const [x, y] of places || []) {
      const [u, v] = view.toCanvas(x, y);
      if (!this.inside([u, v], 20)) continue;
      const r = Math.max(7 * unit, view.scale * 3);
      context.beginPath();
      for (const [a, b] of [[0, -r], [r, 0], [0, r], [-r, 0]]) context.lineTo(u + a, v + b);
      context.closePath();
      context.stroke();
    }
  }

  // Clipped stars have a second, square ring, so that they differ in shape, not in colour alone.
  drawRings(stars) {
    const { context, unit, view } = this;
    for (const [x, y, magnitude, , , clipped] of stars) {
      const [u, v] = view.toCanvas(x, y);
      if (!this.inside([u, v], 20)) continue;
      const radius = Math.max((3.5 + 0.9 * Math.max(FAINTEST_RING_MAG - magnitude, 0)) * unit, view.scale * 2.5);
      if (this.on.truth) {
        context.strokeStyle = INK.truth;
        context.lineWidth = 1.2 * unit;
        context.beginPath();
        context.arc(u, v, radius, 0, 2 * Math.PI);
        context.stroke();
      }
      if (clipped && this.on.clipped) {
        context.strokeStyle = INK.clipped;
        context.lineWidth = 2 * unit;
        context.strokeRect(u - radius - 3 * unit, v - radius - 3 * unit, 2 * radius + 6 * unit, 2 * radius + 6 * unit);
      }
    }
  }

  drawBoresight([x, y]) {
    const { context, unit } = this;
    const [u, v] = this.view.toCanvas(x, y);
    // A name crossed by one of the cross's bars would look struck out.
    this.taken.push([u - 24 * unit, v - unit, u + 24 * unit, v + unit], [u - unit, v - 24 * unit, u + unit, v + 24 * unit]);
    context.strokeStyle = INK.boresight;
    context.lineWidth = 1.5 * unit;
    context.beginPath();
    for (const [a, b] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
      context.moveTo(u + a * 7 * unit, v + b * 7 * unit);
      context.lineTo(u + a * 24 * unit, v + b * 24 * unit);
    }
    context.stroke();
  }

  boxOf(text, u, v, size) {
    const { unit, context } = this;
    context.font = `${size * unit}px system-ui, sans-serif`;
    return [u - 2 * unit, v - size * 0.65 * unit, u + context.measureText(text).width + 2 * unit, v + size * 0.65 * unit];
  }

  // True if the whole label fits: inside, on no other label, no star and not on the outline of the field. Its place is then reserved.
  place(text, u, v, size) {
    const box = this.boxOf(text, u, v, size);
    const { width, height } = this.canvas;
    if (box[0] < 0 || box[1] < 0 || box[2] > width || box[3] > height) return false;
    if (this.taken.some((other) => box[0] < other[2] && other[0] < box[2] && box[1] < other[3] && other[1] < box[3])) return false;
    if (this.outline.some((from, k) => crosses(from, this.outline[(k + 1) % this.outline.length], box))) return false;
    this.taken.push(box);
    this.labels += 1;
    return true;
  }

  labelOf([, , magnitude, hip, label, clipped]) {
    const parts = [];
    if (this.on.names) parts.push(nameOf([0, 0, 0, hip, label]));
    if (this.on.magnitudes && magnitude !== null) parts.push(magnitude.toFixed(2).replace("-", "\u2212"));
    if (clipped && this.on.clipped) parts.push("clipped");
    return parts.filter(Boolean).join("  ");
  }

  gapOf([, , magnitude, , , clipped]) {
    const square = clipped && this.on.clipped ? 4 * this.unit : 0;
    return square + Math.max((6 + 0.9 * Math.max(FAINTEST_RING_MAG - magnitude, 0)) * this.unit, this.view.scale * 2.5 + 3 * this.unit);
  }

  // Labels of the brightest stars, as many as fit; other stars are named when the pointer is on them.
  drawLabels(stars) {
    const { unit, view, context } = this;
    const places = stars.map(([x, y]) => view.toCanvas(x, y));
    const room = (this.canvas.width * this.canvas.height) / (unit * unit) / LABEL_AREA_PX;
    const most = Math.max(6, Math.min(LABELS, Math.round(room)));
    for (const [u, v] of places) if (this.inside([u, v])) this.taken.push([u - 2 * unit, v - 2 * unit, u + 2 * unit, v + 2 * unit]);
    let written = 0;
    for (const [k, star] of stars.entries()) {
      const [u, v] = places[k];
      const text = this.labelOf(star);
      if (written >= most || !text || !this.inside([u, v])) continue;
      const gap = this.gapOf(star);
      context.font = `${12 * unit}px system-ui, sans-serif`;
      const wide = context.measureText(text).width;
      const tries = [[u + gap, v], [u - gap - wide, v], [u - wide / 2, v - gap - 8 * unit], [u - wide / 2, v + gap + 8 * unit]];
      for (const dy of [-14, 14]) tries.push([u + gap, v + dy * unit], [u - gap - wide, v + dy * unit]); // beside the boresight's cross
      const found = tries.find(([left, top]) => this.place(text, left, top, 12));
      if (!found) continue;
      this.write(text, ...found, star[STAR.clipped] && this.on.clipped ? "#ff9a9a" : INK.name);
      written += 1;
    }
  }

  // The star under the pointer, whether it has a label or not: its name, V, colour, and whether it clips.
  drawPointed(stars, pointer) {
    if (!pointer) return;
    const { unit, view, context } = this;
    const [u, v] = view.toCanvas(...pointer);
    const away = ([x, y]) => Math.hypot(...view.toCanvas(x, y).map((at, k) => at - [u, v][k]));
    const near = stars.reduce((best, star) => (away(star) < (best ? away(best) : POINTED_PX * unit) ? star : best), null);
    if (!near) return;
    const text = labelAll(near);
    const [x, y] = view.toCanvas(near[STAR.x_px], near[STAR.y_px]);
    const gap = this.gapOf(near);
    context.font = `${13 * unit}px system-ui, sans-serif`;
    const wide = context.measureText(text).width + 12 * unit;
    const left = x + gap + wide > this.canvas.width ? x - gap - wide : x + gap;
    const top = Math.min(Math.max(y - 11 * unit, 0), this.canvas.height - 22 * unit);
    context.fillStyle = "rgba(10, 16, 28, 0.92)";
    context.fillRect(left, top, wide, 22 * unit);
    context.strokeStyle = INK.name;
    context.lineWidth = unit;
    context.strokeRect(left, top, wide, 22 * unit);
    this.write(text, left + 6 * unit, top + 11 * unit, "#ffffff", 13);
  }
}

function nameOf([, , , hip, label]) {
  return label || (hip ? `HIP ${hip}` : "");
}

function labelAll(star) {
  const magnitude = star[STAR.v_mag] === null ? "" : `V ${star[STAR.v_mag].toFixed(2).replace("-", "\u2212")}`;
  return [nameOf(star), magnitude, star[STAR.colour], star[STAR.clipped] ? "clipped" : ""].filter(Boolean).join("  ");
}

// The names of the stars in the part of the picture that is seen, the brightest first.
export function seenStars(truth, picture) {
  const { canvas, view } = picture;
  const seen = ([x, y]) => view.toCanvas(x, y).every((at, k) => at >= 0 && at <= [canvas.width, canvas.height][k]);
  return (truth?.stars || []).filter(seen).map(nameOf);
}

// Where every pixel has its code in it, names stand below the picture.
export function pictureText(truth, picture, zoom) {
  const named = picture.hasValues ? seenStars(truth, picture).slice(0, 3).join(", ") : "";
  const out = (truth?.stars || []).filter((star) => star[STAR.colour]?.includes("out of gamut")).length;
  const followed = picture.followed === null ? null : (truth?.stars || []).find((star) => star[STAR.hip] === picture.followed || star[STAR.label] === picture.followed);
  if (followed) return `frame ${picture.frame}  ${zoom}\u00a0%  follows ${nameOf(followed)}`;
  return `frame ${picture.frame}  ${zoom}\u00a0%${named ? `  ${named}` : ""}${out ? `  ${out} out of gamut` : ""}`;
}

// Whether a line from a to b goes through a box (Liang and Barsky 1984).
function crosses(a, b, box) {
  let [from, to] = [0, 1];
  for (const k of [0, 1]) {
    const step = b[k] - a[k];
    if (step === 0) {
      if (a[k] < box[k] || a[k] > box[k + 2]) return false;
      continue;
    }
    const ends = [(box[k] - a[k]) / step, (box[k + 2] - a[k]) / step];
    from = Math.max(from, Math.min(...ends));
    to = Math.min(to, Math.max(...ends));
  }
  return from <= to;
}
