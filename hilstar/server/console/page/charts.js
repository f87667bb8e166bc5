// Charts along time, and histograms, drawn by uPlot (uplot.min.js, MIT). Each chart also has its content as text.

import { count, duration, fixed, make, quantity, write } from "./format.js";

const { uPlot } = globalThis;

const HEIGHT = 144;
const HISTOGRAM_HEIGHT = 132;
const FONT = "11px system-ui, sans-serif";
const LEFT = 44; // CSS pixels for the numbers of the axis
const PADDING = [22, 10, 0, 0]; // room for marks above the plot
const HISTOGRAM_PADDING = [22, 26, 0, 0]; // and at the right for the last number of the axis
const TIME_ROOM_PX = 90;
const VALUE_ROOM_PX = 24;
const RECENT_S = 2; // an older value is not shown as the present one
const IN_SECONDS_MS = 2000; // an axis with a larger range is in s
const CROWDED_PX = 16; // marks that are nearer to each other get no lines, which would hide the curves
const CLICK_PX = 6; // a shorter drag counts as a click
const KEY_STEP = 0.2; // relative to the visible part
const KEY_ZOOM = 2;
const STEPS = [1, 2, 2.5, 5, 10];
const TIME_STEPS_S = [0.1, 0.2, 0.5, 1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 14400, 28800, 86400];

// The times of a run's points before its newest one, s.
export function timesOf(points) {
  const last = points.length ? points[points.length - 1].t_s : 0;
  return points.map((point) => point.t_s - last);
}

export function niceTop(value, ticks = 4) {
  if (!(value > 0)) return 1;
  const rough = value / ticks;
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = STEPS.map((s) => s * power).find((s) => s * ticks >= value * 0.9999);
  return Math.ceil(value / step - 1e-9) * step;
}

export function timeText(seconds, step) {
  const sign = seconds < 0 ? "\u2212" : "";
  const s = Math.abs(seconds);
  if (step < 60 && s <= 90) return `${sign}${Number(s.toFixed(1))}`;
  const whole = Math.round(s);
  const [hour, minute, second] = [Math.floor(whole / 3600), Math.floor(whole / 60) % 60, whole % 60];
  const two = (part) => String(part).padStart(2, "0");
  return hour ? `${sign}${hour}:${two(minute)}:${two(second)}` : `${sign}${minute}:${two(second)}`;
}

function head(figure, level, title, ...more) {
  const caption = make("figcaption", "panel-head");
  const heading = make(level, "", title);
  caption.append(heading, ...more);
  figure.append(caption);
  return heading;
}

// The unit of the values, over their axis.
function unitText({ ctx, bbox }, unit, colour) {
  const ratio = uPlot.pxRatio;
  ctx.save();
  ctx.scale(ratio, ratio);
  ctx.font = FONT;
  ctx.textAlign = "right";
  ctx.textBaseline = "middle";
  ctx.fillStyle = colour;
  ctx.fillText(unit, bbox.left / ratio - 4, 7);
  ctx.restore();
}

// An axis in the page's colours, which may change: uPlot asks for them when it draws.
function axis(ink, more) {
  return { font: FONT, gap: 4, stroke: () => ink.muted, grid: { width: 1, stroke: () => ink.gridLine }, ticks: { show: false }, ...more };
}

// series: {name, unit, digits, ink, t, low, high}, all with the same t; marks: {name, ink, t, n}. Times in s, low and high in the chart's unit.
export class Chart {
  constructor(figure, { title, unit, ink, note = "", onRange = null }) {
    Object.assign(this, { unit, ink, onRange, series: [], marks: [], from: -60, to: 0, cursor: null, hover: null, plot: null });
    this.now = make("span", "now figure");
    this.heading = head(figure, "h2", title, this.now);
    if (note) figure.append(make("p", "second", note));
    this.box = make("div", "plot");
    this.box.setAttribute("role", "img");
    this.text = make("p", "second figure chart-text");
    this.legend = make("p", "legend");
    figure.append(this.box, this.text, this.legend);
    if (onRange) this.listen();
  }

  set(series, marks, from, to) {
    Object.assign(this, { series, marks, from, to });
  }

  draw() {
    const width = this.box.clientWidth;
    if (!width) return;
    if (this.plot?.series.length !== this.series.length + 1) this.begin(width);
    const { plot } = this;
    if (plot.width !== width) plot.setSize({ width, height: HEIGHT });
    plot.batch(() => {
      plot.setData(this.aligned(), false);
      plot.setScale("x", { min: this.from, max: this.to });
    });
    this.tell();
  }

  begin(width) {
    this.plot?.destroy();
    const series = this.series.map(({ ink }) => ({
      stroke: () => this.ink[ink],
      width: 1.5,
      points: { show: false },
      gaps: (plot, number, first, last) => this.gaps(plot, number, first, last),
    }));
    const options = {
      width,
      height: HEIGHT,
      padding: PADDING,
      legend: { show: false },
      cursor: { y: false, points: { show: false }, drag: { x: Boolean(this.onRange), y: false, setScale: false, dist: CLICK_PX }, bind: { dblclick: () => null } },
      series: [{}, ...series],
      scales: { x: { time: false, auto: false }, y: { range: (plot, low, high) => this.range(low, high) } },
      axes: [
        axis(this.ink, { space: TIME_ROOM_PX, size: 20, grid: { show: false }, incrs: TIME_STEPS_S, values: (plot, at, number, room, step) => this.times(at, step) }),
        axis(this.ink, { space: VALUE_ROOM_PX, size: LEFT, values: (plot, at) => this.values(at) }),
      ],
      hooks: {
        drawClear: [() => this.drawBehind()],
        draw: [() => this.drawOver()],
        setCursor: [(plot) => this.point(plot)],
        setSelect: [(plot) => this.select(plot)],
      },
    };
    this.plot = new uPlot(options, this.aligned(), this.box);
  }

  // The minimum and the maximum of a span stand at one time, so that a narrow spike stays visible.
  aligned() {
    const [first] = this.series;
    if (!first) return [[]];
    const spans = this.series.some(({ low, high }) => low !== high);
    if (!spans) return [first.t, ...this.series.map(({ high }) => high)];
    const twice = (one, other) => one.flatMap((value, k) => [value, other[k]]);
    return [twice(first.t, first.t), ...this.series.map(({ low, high }) => twice(low, high))];
  }

  // Missing values make a gap only where there are more of them than between two samples of the series.
  gaps(plot, number, first, last) {
    const [times, values] = [plot.data[0], plot.data[number]];
    const known = [];
    for (let k = first; k <= last; k += 1) if (values[k] !== null && values[k] !== undefined) known.push(plot.valToPos(times[k], "x", true));
    const apart = known.slice(1).map((x, k) => x - known[k]);
    const wide = plot.bbox.width / plot.over.clientWidth || 1;
    const usual = apart.filter((gap) => gap >= wide).sort((one, other) => one - other);
    const spread = Math.max(3 * wide, plot.bbox.width / 24 + wide, 2.5 * (usual[usual.length >> 1] || 0));
    return apart.flatMap((gap, k) => (gap > spread ? [[known[k] + wide, known[k + 1] - wide]] : []));
  }

  range(low, high) {
    const [least, most] = [low ?? 0, high ?? 0];
    const top = most <= 0 && least < 0 ? 0 : niceTop(Math.max(most, -least));
    return [least < 0 ? -niceTop(-least) : 0, top];
  }

  get inSeconds() {
    const { min, max } = this.plot.scales.y;
    return this.unit === "ms" && Math.max(max, -min) >= IN_SECONDS_MS;
  }

  values(places) {
    const scale = this.inSeconds ? 1000 : 1;
    const step = places.length > 1 ? (places[1] - places[0]) / scale : 1;
    const digits = Math.max(0, ...[step, step * 10].map((each) => Math.ceil(-Math.log10(each) - 1e-9)));
    const needed = [0, 1, 2, 3, 4, 5].find((n) => places.every((place) => Math.abs(Number((place / scale).toFixed(n)) - place / scale) < step * 1e-6));
    return places.map((place) => fixed(place / scale, needed ?? digits));
  }

  times(places, step) {
    return places.map((t) => {
      const unit = step < 60 && Math.abs(t) <= 90 ? "\u00a0s" : "";
      return timeText(Math.abs(t) < step / 100 ? 0 : t, step) + unit;
    });
  }

  // Sets a function that draws besides the curves, in CSS pixels of the plot: f(context, x of a time, {left, top, right, bottom}).
  drawn(act) {
    const { ctx, bbox } = this.plot;
    const ratio = uPlot.pxRatio;
    const [left, top] = [bbox.left / ratio, bbox.top / ratio];
    const place = { left, top, right: left + bbox.width / ratio, bottom: top + bbox.height / ratio };
    ctx.save();
    ctx.scale(ratio, ratio);
    act(ctx, (t) => this.plot.valToPos(t, "x", true) / ratio, place);
    ctx.restore();
  }

  drawBehind() {
    this.drawn((context, x, place) => {
      for (const mark of this.marks) if (mark.lasting) this.drawLasting(context, x, place, mark);
    });
  }

  drawOver() {
    unitText(this.plot, this.inSeconds ? "s" : this.unit, this.ink.muted);
    this.drawn((context, x, place) => {
      for (const mark of this.marks) if (!mark.lasting) this.drawMarks(context, x, place, mark);
      if (this.cursor === null || this.cursor < this.from || this.cursor > this.to) return;
      context.fillStyle = this.ink.accent;
      context.fillRect(x(this.cursor) - 0.5, place.top, 1, place.bottom - place.top);
    });
  }

  // A triangle, with a line to the bottom where there are few: missed frames and refused packets differ from curves in shape, not
  // in colour alone.
  drawMarks(context, x, { top, bottom, right, left }, { ink, t, n, flag }) {
    context.fillStyle = this.ink[ink];
    const places = t.filter((at, k) => n[k] && at >= this.from && at <= this.to).map(x);
    const crowded = places.length > (right - left) / CROWDED_PX;
    for (const at of places) {
      context.globalAlpha = 0.5;
      if (!crowded && !flag) context.fillRect(at - 0.5, top, 1, bottom - top);
      context.globalAlpha = 1;
      context.beginPath();
      // an operator's action is a diamond on the axis
      const corners = flag ? [[0, bottom - 5], [5, bottom], [0, bottom + 5], [-5, bottom]] : [[-4, top - 6], [4, top - 6], [0, top + 1]];
      for (const [dx, y] of corners) context.lineTo(at + dx, y);
      context.fill();
    }
  }

  // A lasting condition shades its time, with a bar above.
  drawLasting(context, x, { top, bottom }, { ink, t, n }) {
    context.fillStyle = this.ink[ink];
    let begun = null;
    for (let k = 0; k <= t.length; k += 1) {
      const on = k < t.length && n[k];
      if (on && begun === null) begun = t[k];
      if (on || begun === null) continue;
      const [a, b] = [Math.max(begun, this.from), Math.min(k < t.length ? t[k] : this.to, this.to)];
      const [left, wide] = [x(a), Math.max(x(b) - x(a), 1)];
      if (b >= a) {
        context.globalAlpha = 0.22;
        context.fillRect(left, top, wide, bottom - top);
        context.globalAlpha = 1;
        context.fillRect(left, top - 6, wide, 3);
      }
      begun = null;
    }
  }

  // The user chooses a part of the time by dragging, by keys while the chart has the focus, or by the wheel with Ctrl; a click
  // chooses a moment.
  // Calls onRange({from, to}) for a part, {pick} for a moment, {whole: true} for all of it.
  listen() {
    const { box } = this;
    box.tabIndex = 0;
    box.classList.add("ranged");
    let pressed = null;
    box.addEventListener("pointerdown", (event) => (pressed = event.clientX));
    box.addEventListener("click", (event) => {
      if (pressed !== null && Math.abs(event.clientX - pressed) < CLICK_PX) this.onRange({ pick: this.timeAt(event) });
      pressed = null;
    });
    box.addEventListener("dblclick", () => this.onRange({ whole: true }));
    box.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
    box.addEventListener("keydown", (event) => this.key(event));
  }

  timeAt(event) {
    const place = this.plot.over.getBoundingClientRect();
    return this.plot.posToVal(Math.min(Math.max(event.clientX - place.left, 0), place.width), "x");
  }

  select(plot) {
    const { left, width } = plot.select;
    if (width < CLICK_PX) return;
    const [from, to] = [left, left + width].map((at) => plot.posToVal(at, "x"));
    plot.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
    this.onRange({ from, to });
  }

  wheel(event) {
    if (!event.ctrlKey) return;
    event.preventDefault();
    this.zoom(Math.exp(event.deltaY * 0.002), this.timeAt(event));
  }

  zoom(factor, about) {
    const { from, to } = this;
    this.onRange({ from: about - (about - from) * factor, to: about + (to - about) * factor });
  }

  key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const { from, to, cursor } = this;
    const step = (to - from) * KEY_STEP;
    const about = cursor !== null && cursor > from && cursor < to ? cursor : (from + to) / 2;
    const acts = {
      ArrowLeft: () => this.onRange({ from: from - step, to: to - step }),
      ArrowRight: () => this.onRange({ from: from + step, to: to + step }),
      "+": () => this.zoom(1 / KEY_ZOOM, about),
      "-": () => this.zoom(KEY_ZOOM, about),
      0: () => this.onRange({ whole: true }),
    };
    if (!acts[event.key]) return;
    acts[event.key]();
    event.preventDefault();
    event.stopPropagation();
  }

  point(plot) {
    const { left } = plot.cursor;
    this.hover = left >= 0 && plot.cursor.event ? plot.posToVal(left, "x") : null;
    this.tell();
  }

  // Writes the newest value or the one under the pointer or cursor, and the minimum and maximum of the visible part.
  tell() {
    const at = this.hover ?? this.cursor;
    const parts = this.series.map((one) => {
      const value = at === null ? lastOf(one, this.to) : valueAt(one, at);
      return { one, value, seen: rangeOf(one, this.from, this.to) };
    });
    const named = parts.length > 1;
    write(this.now, parts.length ? quantity(parts[0].value, this.unit, parts[0].one.digits) : "");
    const range = parts.map(({ one, seen }) => (Number.isFinite(seen[0]) ? `${named ? `${one.name} ` : ""}${rangeText(seen, this.unit, one.digits)}` : `${named ? `${one.name} ` : ""}no value`));
    const lost = this.marks.filter((mark) => !mark.flag).map((mark) => `${this.countOf(mark)} ${mark.name}`);
    const where = at === null ? "" : `at ${timeText(at, 1)}${Math.abs(at) <= 90 ? "\u00a0s" : ""}; `;
    const words = where + [...range, ...lost].join(" \u00b7 ");
    write(this.text, words);
    this.box.setAttribute("aria-label", `${this.heading.textContent}, ${this.now.textContent}; ${words}`);
    this.tellLegend();
  }

  countOf({ t, n, count: beginnings }) {
    return (beginnings || t).reduce((sum, at, k) => {
      if (at < this.from || at > this.to) return sum;
      return sum + (beginnings ? 1 : n[k] || 0);
    }, 0);
  }

  tellLegend() {
    const rows = [...(this.series.length > 1 ? this.series : []), ...this.marks.filter((mark) => !mark.flag)];
    if (this.legend.childElementCount === rows.length) return;
    this.legend.replaceChildren(...rows.map(({ name, ink }) => make("span", `key ink-${ink}`, name)));
  }
}

// How often a figure had each value, over a whole run: bars on a logarithmic scale, so that the rare ones are seen.
export class Histogram {
  constructor(figure, { title, unit, ink }) {
    Object.assign(this, { title, unit, ink, counts: [], from: 0, to: 1, plot: null });
    head(figure, "h3", title);
    this.box = make("div", "plot");
    this.box.setAttribute("role", "img");
    this.text = make("p", "second figure chart-text");
    figure.append(this.box, this.text);
  }

  set({ from_ms: from, to_ms: to, counts }) {
    Object.assign(this, { from, to, counts });
    this.total = counts.reduce((sum, n) => sum + n, 0);
  }

  draw() {
    const width = this.box.clientWidth;
    if (!width) return;
    if (!this.plot) this.begin(width);
    else if (this.plot.width !== width) this.plot.setSize({ width, height: HISTOGRAM_HEIGHT });
    else this.plot.redraw();
    this.tell(null);
  }

  begin(width) {
    const step = this.step;
    const middles = this.counts.map((_, k) => this.from + (k + 0.5) * step);
    const decades = Math.max(Math.ceil(Math.log10(Math.max(...this.counts, 1)) + 1e-9), 1);
    const powers = [...Array(decades + 1).keys()].map((power) => 10 ** power);
    const options = {
      width,
      height: HISTOGRAM_HEIGHT,
      padding: HISTOGRAM_PADDING,
      legend: { show: false },
      cursor: { y: false, points: { show: false }, drag: { x: false, y: false }, bind: { dblclick: () => null } },
      series: [{}, { fill: () => this.ink.one, width: 0, points: { show: false }, paths: uPlot.paths.bars({ size: [1], gap: 0.5 }) }],
      scales: { x: { time: false, range: [this.from, this.to] }, y: { distr: 3, range: [0.5, 10 ** decades] } },
      axes: [
        axis(this.ink, { size: 20, grid: { show: false }, space: TIME_ROOM_PX, values: (plot, at) => at.map((x) => `${Number(x.toFixed(4))}\u00a0${this.unit}`) }),
        axis(this.ink, { size: LEFT, splits: () => powers, filter: (plot, at) => at, values: (plot, at) => at.map(powerText) }),
      ],
      hooks: {
        draw: [(plot) => unitText(plot, "frames", this.ink.muted)],
        setCursor: [(plot) => this.tell(plot.cursor.left >= 0 ? plot.cursor.idx : null)],
      },
    };
    this.plot = new uPlot(options, [middles, this.counts.map((n) => n || null)], this.box);
  }

  get step() {
    return (this.to - this.from) / Math.max(this.counts.length, 1);
  }

  get digits() {
    const span = this.to - this.from;
    return span < 0.1 ? 4 : span < 1 ? 3 : span < 20 ? 2 : 1;
  }

  tell(bar) {
    const at = (k) => fixed(this.from + k * this.step, this.digits);
    const range = `${at(0)} to ${at(this.counts.length)}\u00a0${this.unit}, ${count(this.total)} frames`;
    const words = bar === null || bar === undefined ? range : `${at(bar)} to ${at(bar + 1)}\u00a0${this.unit}: ${count(this.counts[bar])} frames`;
    write(this.text, words);
    this.box.setAttribute("aria-label", `${this.title}: ${words}`);
  }
}

function powerText(n) {
  const power = Math.round(Math.log10(n));
  return power < 3 ? String(n) : `10${["", "", "", "\u00b3", "\u2074", "\u2075", "\u2076", "\u2077"][power] || "^"}`;
}

// The newest value, if it is recent: a slow run has points without a frame.
function lastOf({ t, high }, to) {
  for (let k = high.length - 1; k >= 0 && t[k] >= to - RECENT_S; k -= 1) if (high[k] !== null && high[k] !== undefined) return high[k];
  return null;
}

function rangeOf({ t, low, high }, from, to) {
  let [least, most] = [Infinity, -Infinity];
  for (let k = 0; k < t.length; k += 1) {
    if (t[k] < from || t[k] > to || low[k] === null || low[k] === undefined) continue;
    least = Math.min(least, low[k]);
    most = Math.max(most, high[k]);
  }
  return [least, most];
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
