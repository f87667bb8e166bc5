// How often a figure had each value, over a whole run: bars on a logarithmic scale, so that the rare ones are seen.

import { count, fixed, make, write } from "./format.js";

const HEIGHT = 132;
const LEFT = 40;
const RIGHT = 10;
const TOP = 22;
const BOTTOM = 20;

export class Histogram {
  constructor(figure, { title, unit, ink }) {
    Object.assign(this, { unit, ink, counts: [], from: 0, to: 1 });
    const head = make("figcaption", "panel-head");
    head.append(make("h3", "", title));
    this.canvas = make("canvas");
    this.canvas.setAttribute("role", "img");
    this.title = title;
    this.text = make("p", "second figure chart-text");
    figure.append(head, this.canvas, this.text);
    this.context = this.canvas.getContext("2d");
    this.canvas.addEventListener("pointermove", (event) => this.point(event));
    this.canvas.addEventListener("pointerleave", () => this.tell(null));
  }

  set({ from_ms: from, to_ms: to, counts }) {
    Object.assign(this, { from, to, counts });
    this.total = counts.reduce((sum, n) => sum + n, 0);
  }

  draw() {
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    const w = this.canvas.clientWidth;
    if (!w) return;
    Object.assign(this.canvas, { width: Math.round(w * ratio), height: Math.round(HEIGHT * ratio) });
    const { context, ink, counts } = this;
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    const decades = Math.max(Math.ceil(Math.log10(Math.max(...counts, 1)) + 1e-9), 1);
    const y = (n) => HEIGHT - BOTTOM - (Math.log10(Math.max(n, 0.5) * 2) / (decades + Math.log10(2))) * (HEIGHT - BOTTOM - TOP);
    context.font = "11px system-ui, sans-serif";
    context.textBaseline = "middle";
    context.textAlign = "right";
    for (let power = 0; power <= decades; power += 1) {
      context.fillStyle = ink.gridLine;
      context.fillRect(LEFT, Math.round(y(10 ** power)), w - LEFT - RIGHT, 1);
      context.fillStyle = ink.muted;
      context.fillText(power < 3 ? String(10 ** power) : `10${["", "", "", "\u00b3", "\u2074", "\u2075", "\u2076", "\u2077"][power] || "^"}`, LEFT - 6, y(10 ** power));
    }
    context.textAlign = "left";
    context.fillText("frames", 2, 6);
    const width = (w - LEFT - RIGHT) / Math.max(counts.length, 1);
    context.fillStyle = ink.one;
    counts.forEach((n, k) => n && context.fillRect(LEFT + k * width, y(n), Math.max(width - 0.5, 0.5), HEIGHT - BOTTOM - y(n)));
    context.fillStyle = ink.muted;
    for (const [share, align] of [[0, "left"], [0.5, "center"], [1, "right"]]) {
      context.textAlign = align;
      const unit = share === 1 ? `\u00a0${this.unit}` : "";
      context.fillText(fixed(this.from + share * (this.to - this.from), this.digits) + unit, LEFT + share * (w - LEFT - RIGHT), HEIGHT - BOTTOM / 2 + 2);
    }
    this.tell(null);
  }

  get digits() {
    const span = this.to - this.from;
    return span < 0.1 ? 4 : span < 1 ? 3 : span < 20 ? 2 : 1;
  }

  point(event) {
    const box = this.canvas.getBoundingClientRect();
    const share = (event.clientX - box.left - LEFT) / Math.max(box.width - LEFT - RIGHT, 1);
    this.tell(share >= 0 && share < 1 ? Math.floor(share * this.counts.length) : null);
  }

  tell(bar) {
    const step = (this.to - this.from) / Math.max(this.counts.length, 1);
    const at = (k) => fixed(this.from + k * step, this.digits);
    const range = `${at(0)} to ${at(this.counts.length)}\u00a0${this.unit}, ${count(this.total)} frames`;
    const words = bar === null ? range : `${at(bar)} to ${at(bar + 1)}\u00a0${this.unit}: ${count(this.counts[bar])} frames`;
    write(this.text, words);
    this.canvas.setAttribute("aria-label", `${this.title}: ${words}`);
  }
}
