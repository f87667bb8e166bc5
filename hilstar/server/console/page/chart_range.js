// Choosing a part of a chart's time: by dragging over it, by keys when it has the focus, by the wheel with Ctrl; a press picks a moment.

const MIN_DRAG_PX = 6;
const KEY_STEP = 0.2; // of what is seen
const KEY_ZOOM = 2;

export class ChartRange {
  // onRange({from, to}) for a new part, {pick} for a moment, {whole: true} for all of it.
  constructor(chart, onRange) {
    Object.assign(this, { chart, onRange, begun: null });
    const { canvas } = chart;
    canvas.tabIndex = 0;
    canvas.classList.add("ranged");
    canvas.addEventListener("pointerdown", (event) => this.press(event));
    canvas.addEventListener("pointermove", (event) => this.drag(event));
    canvas.addEventListener("pointerup", (event) => this.release(event));
    canvas.addEventListener("pointercancel", () => this.forget());
    canvas.addEventListener("dblclick", () => this.onRange({ whole: true }));
    canvas.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
    canvas.addEventListener("keydown", (event) => this.key(event));
  }

  press(event) {
    if (event.button) return;
    this.begun = [event.clientX, this.chart.timeAt(event)];
    if (event.pointerType === "mouse") this.chart.canvas.setPointerCapture(event.pointerId);
  }

  drag(event) {
    if (!this.begun || event.pointerType !== "mouse") return;
    const far = Math.abs(event.clientX - this.begun[0]) >= MIN_DRAG_PX;
    this.chart.chosen = far ? [this.begun[1], this.chart.timeAt(event)] : null;
  }

  release(event) {
    if (!this.begun) return;
    const [x, from] = this.begun;
    const at = this.chart.timeAt(event);
    this.forget();
    if (Math.abs(event.clientX - x) < MIN_DRAG_PX) this.onRange({ pick: at });
    else if (event.pointerType === "mouse") this.onRange({ from: Math.min(from, at), to: Math.max(from, at) });
  }

  forget() {
    this.begun = null;
    this.chart.chosen = null;
  }

  wheel(event) {
    if (!event.ctrlKey) return;
    event.preventDefault();
    this.zoom(Math.exp(event.deltaY * 0.002), this.chart.timeAt(event));
  }

  zoom(factor, about) {
    const { from, to } = this.chart;
    this.onRange({ from: about - (about - from) * factor, to: about + (to - about) * factor });
  }

  key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const { from, to, cursor } = this.chart;
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
}
