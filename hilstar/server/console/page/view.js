// The visible part of the picture: zoom, in device pixels per monitor pixel, and panning, by mouse, touch and keys.

export const PIXELS_ZOOM = 40; // CSS pixels per monitor pixel at which code values are easily read
const MAX_ZOOM = 96;
const STEP = Math.SQRT2;
const PAN_SHARE = 0.15; // relative to the view, per press of an arrow key

export class View {
  constructor(canvas, onChange) {
    // `onHand` is called when the user moves the picture, which then follows no star any more
    Object.assign(this, { canvas, onChange, onHand: () => {}, w: 16, h: 9, cx: 7.5, cy: 4, zoom: null, ratio: 1, pointers: new Map(), moved: 0 });
    canvas.addEventListener("pointerdown", (event) => this.press(event));
    canvas.addEventListener("pointermove", (event) => this.drag(event));
    for (const kind of ["pointerup", "pointercancel"]) canvas.addEventListener(kind, (event) => this.release(event));
    canvas.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
    canvas.addEventListener("dblclick", (event) => {
      this.onHand();
      this.zoomBy(4, this.at(event));
    });
  }

  setSize(w, h) {
    if (w === this.w && h === this.h) return;
    Object.assign(this, { w, h, cx: (w - 1) / 2, cy: (h - 1) / 2, zoom: null });
    this.settle();
  }

  get fitZoom() {
    return Math.min(this.canvas.width / this.w, this.canvas.height / this.h);
  }

  // Device pixels per monitor pixel.
  get scale() {
    return this.zoom === null ? this.fitZoom : this.zoom;
  }

  get fitted() {
    return this.zoom === null;
  }

  // The position on the canvas, device pixels, of a position on the monitor, whose top-left pixel has its centre at (0, 0).
  toCanvas(x, y) {
    const s = this.scale;
    return [(x - this.cx) * s + this.canvas.width / 2, (y - this.cy) * s + this.canvas.height / 2];
  }

  toMonitor(u, v) {
    const s = this.scale;
    return [(u - this.canvas.width / 2) / s + this.cx, (v - this.canvas.height / 2) / s + this.cy];
  }

  at(event) {
    const box = this.canvas.getBoundingClientRect();
    return this.toMonitor((event.clientX - box.left) * this.ratio, (event.clientY - box.top) * this.ratio);
  }

  fit() {
    this.onHand();
    this.zoom = null;
    this.settle();
  }

  setZoom(zoom, about = [this.cx, this.cy], centre = false) {
    const before = this.scale;
    this.zoom = Math.min(Math.max(zoom, this.fitZoom), MAX_ZOOM * this.ratio);
    const keep = centre ? 0 : before / this.zoom;
    this.cx = about[0] + (this.cx - about[0]) * keep;
    this.cy = about[1] + (this.cy - about[1]) * keep;
    if (this.zoom <= this.fitZoom * 1.001) this.zoom = null;
    this.settle();
  }

  centreOn([x, y]) {
    Object.assign(this, { cx: x, cy: y });
    this.settle();
  }

  zoomBy(factor, about) {
    this.setZoom(this.scale * factor, about);
  }

  zoomStep(direction) {
    this.zoomBy(direction > 0 ? STEP : 1 / STEP);
  }

  pan(right, down) {
    this.onHand();
    this.cx += (right * PAN_SHARE * this.canvas.width) / this.scale;
    this.cy += (down * PAN_SHARE * this.canvas.height) / this.scale;
    this.settle();
  }

  // Limits panning: beyond the edges of the picture nothing black is visible, unless the picture is smaller than the window.
  settle() {
    const s = this.scale;
    for (const [centre, size, room] of [["cx", this.w, this.canvas.width], ["cy", this.h, this.canvas.height]]) {
      const half = room / s / 2;
      const middle = (size - 1) / 2;
      const reach = Math.max(size / 2 - half, 0);
      this[centre] = Math.min(Math.max(this[centre], middle - reach), middle + reach);
    }
    this.canvas.classList.toggle("zoomed", !this.fitted);
    this.onChange();
  }

  press(event) {
    this.pointers.set(event.pointerId, [event.clientX, event.clientY]);
    this.moved = 0;
    if (!this.fitted || this.pointers.size > 1) this.canvas.setPointerCapture(event.pointerId);
  }

  drag(event) {
    const before = this.pointers.get(event.pointerId);
    if (!before) return;
    const now = [event.clientX, event.clientY];
    const [dx, dy] = [now[0] - before[0], now[1] - before[1]];
    if (this.pointers.size === 2) this.pinch(event, now);
    this.pointers.set(event.pointerId, now);
    this.moved += Math.hypot(dx, dy);
    if (this.fitted) return;
    this.onHand();
    const share = this.ratio / this.scale / this.pointers.size;
    this.cx -= dx * share;
    this.cy -= dy * share;
    this.settle();
  }

  pinch(event, now) {
    const other = [...this.pointers].find(([id]) => id !== event.pointerId)[1];
    const before = this.pointers.get(event.pointerId);
    const gap = (a, b) => Math.hypot(a[0] - b[0], a[1] - b[1]);
    const box = this.canvas.getBoundingClientRect();
    const middle = [(now[0] + other[0]) / 2 - box.left, (now[1] + other[1]) / 2 - box.top];
    this.zoomBy(gap(now, other) / Math.max(gap(before, other), 1), this.toMonitor(middle[0] * this.ratio, middle[1] * this.ratio));
  }

  release(event) {
    this.pointers.delete(event.pointerId);
  }

  // The wheel zooms only with Ctrl, in a zoomed picture, or while the picture has the focus: otherwise it scrolls the page.
  wheel(event) {
    if (!event.ctrlKey && this.fitted && document.activeElement !== this.canvas) return;
    event.preventDefault();
    this.onHand();
    this.zoomBy(Math.exp(-event.deltaY * 0.002), this.at(event));
  }
}
