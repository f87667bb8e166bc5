// A chart along time: lines, or bands from minimum to maximum, and marks where something was lost. What it shows is written in words too.

import { ChartRange } from "./chart_range.js";
import { duration, fixed, make, quantity, write } from "./format.js";

const HEIGHT = 144;
const LEFT = 44;
const BOTTOM = 20;
const TOP = 22;
const RIGHT = 10;
const RECENT_S = 2; // a value that is older is none
const IN_SECONDS_MS = 2000; // an axis of more is in s
const CROWDED_PX = 16; // between marks, from which their lines would hide the curves
const STEPS = [1, 2, 2.5, 5, 10];
const TIME_STEPS_S = [0.1, 0.2, 0.5, 1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 14400, 28800, 86400];

export function niceTop(value, ticks = 4) {
  if (!(value > 0)) return [1, 0.25];
  const rough = value / ticks;
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = STEPS.map((s) => s * power).find((s) => s * ticks >= value * 0.9999);
  return [Math.ceil(value / step - 1e-9) * step, step];
}

export function timeText(seconds, step) {
  const sign = seconds < 0 ? "\u2212" : "";
  const s = Math.abs(seconds);
  if (step < 60 && s <= 90) return `${sign}${Number(s.toFixed(1))}`;
  const [hour, minute, second] = [Math.floor(s / 3600), Math.floor(s / 60) % 60, Math.round(s % 60)];
  const two = (part) => String(part).padStart(2, "0");
  return hour ? `${sign}${hour}:${two(minute)}:${two(second)}` : `${sign}${minute}:${two(second)}`;
}

// The minimum and the maximum of each of so many columns: no spike is too thin to be seen.
export function envelope(t, low, high, from, to, columns) {
  const [lows, highs] = [new Float64Array(columns).fill(Infinity), new Float64Array(columns).fill(-Infinity)];
  for (let k = 0; k < t.length; k += 1) {
    if (t[k] < from || t[k] > to || low[k] === null || low[k] === undefined) continue;
    const column = Math.min(Math.floor(((t[k] - from) / (to - from || 1)) * columns), columns - 1);
    if (low[k] < lows[column]) lows[column] = low[k];
    if (high[k] > highs[column]) highs[column] = high[k];
  }
  return [lows, highs];
}

// series: {name, unit, digits, ink, t, low, high}; marks: {name, ink, t, n}. Times in s, low and high in the chart's unit.
export class Chart {
  constructor(figure, { title, unit, ink, note = "", onPick = null, onRange = null }) {
    Object.assign(this, { figure, unit, ink, onPick, series: [], marks: [], from: -60, to: 0, cursor: null, hover: null, chosen: null });
    const head = make("figcaption", "panel-head");
    this.heading = make("h2", "", title);
    this.now = make("span", "now figure");
    head.append(this.heading, this.now);
    this.canvas = make("canvas");
    this.canvas.setAttribute("role", "img");
    this.text = make("p", "second figure chart-text");
    this.legend = make("p", "legend");
    figure.append(head, ...(note ? [make("p", "second", note)] : []), this.canvas, this.text, this.legend);
    this.context = this.canvas.getContext("2d");
    this.canvas.addEventListener("pointermove", (event) => this.point(event));
    this.canvas.addEventListener("pointerleave", () => this.point(null));
    if (onRange) this.range = new ChartRange(this, onRange);
  }

  set(series, marks, from, to) {
    Object.assign(this, { series, marks, from, to });
  }

  timeAt(event) {
    const box = this.canvas.getBoundingClientRect();
    const share = (event.clientX - box.left - LEFT) / Math.max(box.width - LEFT - RIGHT, 1);
    return this.from + Math.min(Math.max(share, 0), 1) * (this.to - this.from);
  }

  point(event) {
    this.hover = event && this.timeAt(event);
    this.draw();
  }

  x(t) {
    return LEFT + ((t - this.from) / (this.to - this.from || 1)) * (this.w - LEFT - RIGHT);
  }

  y(value) {
    return HEIGHT - BOTTOM - ((value - this.bottom) / (this.top - this.bottom || 1)) * (HEIGHT - BOTTOM - TOP);
  }

  fit() {
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    this.w = this.canvas.clientWidth;
    if (!this.w) return false;
    const [w, h] = [Math.round(this.w * ratio), Math.round(HEIGHT * ratio)];
    if (this.canvas.width !== w || this.canvas.height !== h) Object.assign(this.canvas, { width: w, height: h });
    this.context.setTransform(ratio, 0, 0, ratio, 0, 0);
    return true;
  }

  draw() {
    if (!this.fit()) return;
    const { context } = this;
    context.clearRect(0, 0, this.w, HEIGHT);
    const columns = Math.max(Math.floor(this.w - LEFT - RIGHT), 1);
    this.bands = this.series.map((one) => envelope(one.t, one.low, one.high, this.from, this.to, columns));
    const known = (pick, start) => this.bands.reduce((best, band) => band.reduce((a, part) => part.reduce(pick, a), best), start);
    const high = known((a, b) => (Number.isFinite(b) ? Math.max(a, b) : a), 0);
    const low = known((a, b) => (Number.isFinite(b) ? Math.min(a, b) : a), 0);
    [this.top, this.step] = niceTop(Math.max(high, -low));
    if (high <= 0 && low < 0) this.top = 0;
    this.bottom = low < 0 ? -niceTop(-low)[0] : 0;
    this.drawAxes();
    for (const mark of this.marks) this.drawMarks(mark);
    this.series.forEach((one, k) => this.drawBand(one, this.bands[k]));
    this.drawCursor();
    this.drawChosen();
    this.tell();
  }

  drawAxes() {
    const { context, ink } = this;
    context.font = "11px system-ui, sans-serif";
    context.textBaseline = "middle";
    context.textAlign = "right";
    context.lineWidth = 1;
    const [scale, unit] = this.unit === "ms" && Math.max(this.top, -this.bottom) >= IN_SECONDS_MS ? [1000, "s"] : [1, this.unit];
    const step = this.step / scale;
    const digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9) + (step / 10 ** Math.floor(Math.log10(step)) === 2.5 ? 1 : 0));
    context.fillStyle = ink.muted;
    context.fillText(unit, LEFT - 6, 6);
    for (let value = this.bottom; value <= this.top + this.step * 0.01; value += this.step) {
      const y = Math.round(this.y(value)) + 0.5;
      context.strokeStyle = Math.abs(value) < this.step / 100 ? ink.axis : ink.gridLine;
      context.beginPath();
      context.moveTo(LEFT, y);
      context.lineTo(this.w - RIGHT, y);
      context.stroke();
      context.fillStyle = ink.muted;
      context.fillText(fixed(value / scale, digits), LEFT - 6, y);
    }
    this.drawTimes();
  }

  drawTimes() {
    const { context, ink } = this;
    const span = this.to - this.from;
    const step = TIME_STEPS_S.find((s) => span / s <= Math.max((this.w - LEFT) / 90, 2)) || span;
    context.textAlign = "center";
    context.fillStyle = ink.muted;
    for (let t = Math.ceil(this.from / step - 1e-9) * step; t <= this.to + step * 1e-6; t += step) {
      const text = timeText(Math.abs(t) < step / 100 ? 0 : t, step);
      const half = context.measureText(text).width / 2;
      const unit = step < 60 && Math.abs(t) <= 90 ? "\u00a0s" : "";
      context.fillText(text + unit, Math.min(this.x(t), this.w - half - 8), HEIGHT - BOTTOM / 2 + 2);
    }
  }

  drawBand({ ink: name }, [lows, highs]) {
    const { context } = this;
    context.strokeStyle = this.ink[name];
    context.fillStyle = this.ink[name];
    context.lineWidth = 1.5;
    context.lineCap = "round"; // a sample alone is a dot
    context.beginPath();
    // Columns without a value are a gap where they are more than those between the series' own samples.
    const known = [...lows.keys()].filter((k) => Number.isFinite(lows[k]));
    const apart = known.slice(1).map((k, n) => k - known[n]).sort((one, other) => one - other);
    const spread = Math.max(3, lows.length / 24 + 1, 2.5 * (apart[apart.length >> 1] || 0));
    known.forEach((k, n) => {
      const x = LEFT + k + 0.5;
      const joined = n > 0 && k - known[n - 1] <= spread;
      context[joined ? "lineTo" : "moveTo"](x, this.y(lows[k]));
      context.lineTo(x, this.y(highs[k]) - (joined ? 0 : 0.01));
    });
    context.stroke();
  }

  // A triangle, and where they are few a line to the bottom: lost frames and refused packets are seen without their colour.
  drawMarks(mark) {
    const { ink: name, t, n } = mark;
    const { context } = this;
    context.strokeStyle = context.fillStyle = this.ink[name];
    if (mark.lasting) {
      this.drawLasting(mark);
      return;
    }
    const seen = t.map((at, k) => (n[k] && at >= this.from && at <= this.to ? this.x(at) : null)).filter((x) => x !== null);
    const crowded = seen.length > this.w / CROWDED_PX;
    if (mark.flag) {
      this.drawFlags(seen);
      return;
    }
    for (const x of seen) {
      context.globalAlpha = 0.5;
      if (!crowded) context.fillRect(x - 0.5, TOP, 1, HEIGHT - BOTTOM - TOP);
      context.globalAlpha = 1;
      context.beginPath();
      context.moveTo(x - 4, TOP - 6);
      context.lineTo(x + 4, TOP - 6);
      context.lineTo(x, TOP + 1);
      context.fill();
    }
    context.globalAlpha = 1;
  }

  // A diamond on the axis, for what somebody did.
  drawFlags(places) {
    const { context } = this;
    const y = HEIGHT - BOTTOM;
    for (const x of places) {
      context.beginPath();
      for (const [dx, dy] of [[0, -5], [5, 0], [0, 5], [-5, 0]]) context.lineTo(x + dx, y + dy);
      context.fill();
    }
  }

  // What lasts is a shade over its time, with a triangle where it begins.
  drawLasting({ t, n }) {
    const { context } = this;
    const y = TOP - 6;
    let begun = null;
    for (let k = 0; k <= t.length; k += 1) {
      const on = k < t.length && n[k];
      if (on && begun === null) begun = t[k];
      if (on || begun === null) continue;
      const [a, b] = [Math.max(begun, this.from), Math.min(k < t.length ? t[k] : this.to, this.to)];
      const [left, right] = [this.x(a), Math.max(this.x(b), this.x(a) + 1)];
      if (b >= a) {
        context.globalAlpha = 0.22;
        context.fillRect(left, TOP, right - left, HEIGHT - BOTTOM - TOP);
        context.globalAlpha = 1;
        context.fillRect(left, y, right - left, 3);
      }
      begun = null;
    }
  }

  drawCursor() {
    const { context, ink } = this;
    for (const [at, colour] of [[this.cursor, ink.accent], [this.hover, ink.muted]]) {
      if (at === null || at < this.from || at > this.to) continue;
      context.fillStyle = colour;
      context.fillRect(this.x(at) - 0.5, TOP, 1, HEIGHT - BOTTOM - TOP);
    }
  }

  // The part that is being chosen to be zoomed into.
  drawChosen() {
    if (!this.chosen) return;
    const [a, b] = this.chosen.map((t) => this.x(t));
    this.context.globalAlpha = 0.2;
    this.context.fillStyle = this.ink.accent;
    this.context.fillRect(Math.min(a, b), TOP, Math.abs(b - a), HEIGHT - BOTTOM - TOP);
    this.context.globalAlpha = 1;
  }

  // The newest value, or that under the pointer, the cursor; minimum and maximum of what is seen.
  tell() {
    const at = this.hover ?? this.cursor;
    const parts = this.series.map((one, k) => {
      const [lows, highs] = this.bands[k];
      const seen = [Math.min(...lows), Math.max(...highs)];
      const value = at === null ? lastOf(one, this.to) : valueAt(one, at);
      return { one, value, seen };
    });
    const named = parts.length > 1;
    write(this.now, parts.length ? quantity(parts[0].value, this.unit, parts[0].one.digits) : "");
    const range = parts.map(({ one, seen }) => (Number.isFinite(seen[0]) ? `${named ? `${one.name} ` : ""}${rangeText(seen, this.unit, one.digits)}` : `${named ? `${one.name} ` : ""}no value`));
    const lost = this.marks.filter((mark) => !mark.flag).map(({ name, t, n, count }) => `${(count || t).reduce((sum, at, k) => sum + (at >= this.from && at <= this.to ? (count ? 1 : n[k] || 0) : 0), 0)} ${name}`);
    const where = at === null ? "" : `at ${timeText(at, 1)}${Math.abs(at) <= 90 ? "\u00a0s" : ""}; `;
    const words = where + [...range, ...lost].join(" \u00b7 ");
    write(this.text, words);
    this.canvas.setAttribute("aria-label", `${this.heading.textContent}, ${this.now.textContent}; ${words}`);
    this.tellLegend();
  }

  tellLegend() {
    const rows = [...(this.series.length > 1 ? this.series : []), ...this.marks.filter((mark) => !mark.flag)];
    if (this.legend.childElementCount === rows.length) return;
    this.legend.replaceChildren(
      ...rows.map(({ name, ink }) => {
        return make("span", `key ink-${ink}`, name);
      }),
    );
  }
}

// The newest value, if it is recent: a slow run has points without a frame.
function lastOf({ t, high }, to) {
  for (let k = high.length - 1; k >= 0 && t[k] >= to - RECENT_S; k -= 1) if (high[k] !== null && high[k] !== undefined) return high[k];
  return null;
}

function rangeText([low, high], unit, digits) {
  if (unit === "ms" && high >= 1000) return `${duration(low / 1000, digits)} to ${duration(high / 1000, digits)}`;
  return `${fixed(low, digits)} to ${quantity(high, unit, digits)}`;
}

function valueAt({ t, high }, at) {
  let best = null;
  let gap = Infinity;
  for (let k = 0; k < t.length; k += 1) {
    const away = Math.abs(t[k] - at);
    if (away < gap) [best, gap] = [high[k], away];
  }
  return best;
}
