// What is drawn over the picture: the truth of the same frame, from the bench's own stars and lens.

import { make } from "./format.js";

// Key, words on the button, on at first, and the key on the keyboard.
export const OVERLAYS = [
  ["names", "Names", true, "n"],
  ["magnitudes", "Magnitudes", false, "m"],
  ["truth", "Truth", false, "t"],
  ["boresight", "Boresight", true, "x"],
  ["grid", "RA/Dec grid", false, "g"],
  ["tracker", "Tracker field", true, "f"],
  ["clipped", "Clipped", true, "c"],
];
const INK = { truth: "#63d2a1", name: "#c9d6ee", grid: "rgba(110, 150, 225, 0.6)", tracker: "#ffcf70", boresight: "#7db4ff", clipped: "#ff6b6b" };
const LABELS = 60; // the brightest in view; more would hide the stars
const FAINTEST_RING_MAG = 8;
const KEPT_TRUTHS = 12;
const VALUES_FROM = 22; // CSS pixels per monitor pixel from which codes are written (picture.js)

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

  // The truth of this frame; of the newest one where the picture's own has not come.
  of(frame) {
    return this.truths.get(frame) || this.newest;
  }

  draw(frame) {
    const { canvas, context, view } = this;
    canvas.width = view.canvas.width;
    canvas.height = view.canvas.height;
    const truth = this.of(frame);
    if (!truth) return;
    context.lineJoin = "round";
    this.unit = view.ratio;
    this.taken = [];
    if (this.on.grid) this.drawGrid(truth.grid || []);
    if (this.on.tracker) this.drawTracker(truth.tracker_px || []);
    if (this.on.truth || this.on.clipped) this.drawRings(truth.stars || []);
    if (this.on.boresight && truth.boresight_px) this.drawBoresight(truth.boresight_px);
    if (this.on.names || this.on.magnitudes) this.drawLabels(truth.stars || []);
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
      if (!label || !at) continue;
      context.font = `${11 * unit}px system-ui, sans-serif`;
      const left = Math.min(at[0] + 4 * unit, this.canvas.width - context.measureText(label).width - 6 * unit);
      if (this.place(label, left, at[1], 11)) this.write(label, left, at[1] - (left < at[0] ? 8 * unit : 0), "#9dbcf5", 11);
    }
  }

  drawTracker(outline) {
    const { context, unit } = this;
    if (outline.length < 3) return;
    context.strokeStyle = INK.tracker;
    context.lineWidth = 1.5 * unit;
    context.setLineDash([8 * unit, 5 * unit]);
    this.path(outline, true);
    context.stroke();
    context.setLineDash([]);
    const inside = outline.map(([x, y]) => this.view.toCanvas(x, y)).filter((place) => this.inside(place, -6 * unit));
    const top = inside.reduce((best, place) => (best && best[0] + best[1] <= place[0] + place[1] ? best : place), null);
    const label = "tracker\u2019s field";
    if (top && this.place(label, top[0] + 6 * unit, top[1] + 12 * unit, 11)) this.write(label, top[0] + 6 * unit, top[1] + 12 * unit, INK.tracker, 11);
  }

  // Clipped stars have a second, square ring: they are told by shape as well as by colour.
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
    this.taken.push([u - 24 * unit, v - unit, u + 24 * unit, v + unit]); // a name under its bar would look struck out
    context.strokeStyle = INK.boresight;
    context.lineWidth = 1.5 * unit;
    context.beginPath();
    for (const [a, b] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
      context.moveTo(u + a * 7 * unit, v + b * 7 * unit);
      context.lineTo(u + a * 24 * unit, v + b * 24 * unit);
    }
    context.stroke();
  }

  // True, and the place is taken, where no other label stands.
  place(text, u, v, size) {
    const { unit } = this;
    const box = [u - 2 * unit, v - size * 0.65 * unit, u + text.length * size * 0.6 * unit, v + size * 0.65 * unit];
    if (this.taken.some((other) => box[0] < other[2] && other[0] < box[2] && box[1] < other[3] && other[1] < box[3])) return false;
    this.taken.push(box);
    return true;
  }

  labelOf([, , magnitude, hip, label, clipped]) {
    const parts = [];
    if (this.on.names) parts.push(label || (hip ? `HIP ${hip}` : ""));
    if (this.on.magnitudes && magnitude !== null) parts.push(magnitude.toFixed(2).replace("-", "\u2212"));
    if (clipped && this.on.clipped) parts.push("clipped");
    return parts.filter(Boolean).join("  ");
  }

  drawLabels(stars) {
    const { unit, view } = this;
    let written = 0;
    const most = Math.max(8, Math.min(LABELS, Math.round((this.canvas.width * this.canvas.height) / (unit * unit) / 9000)));
    for (const star of stars) {
      const [u, v] = view.toCanvas(star[0], star[1]);
      if (written >= most || !this.inside([u, v])) continue;
      const square = star[5] && this.on.clipped ? 4 * unit : 0;
      const gap = square + Math.max((6 + 0.9 * Math.max(FAINTEST_RING_MAG - star[2], 0)) * unit, view.scale * 2.5 + 3 * unit);
      const text = this.labelOf(star);
      if (!text) continue;
      this.context.font = `${12 * unit}px system-ui, sans-serif`;
      const wide = this.context.measureText(text).width;
      const close = view.scale >= VALUES_FROM * unit; // beside the star it would hide codes
      const beside = u + gap + wide > this.canvas.width ? u - gap - wide : u + gap;
      const above = [u - wide / 2, v - gap - 8 * unit];
      const found = (close ? [above] : [[beside, v], above]).find(([left, top]) => this.place(text, left, top, 12));
      if (!found) continue;
      const [left, top] = found;
      this.write(text, left, top, star[5] && this.on.clipped ? "#ff9a9a" : INK.name);
      written += 1;
    }
  }
}
