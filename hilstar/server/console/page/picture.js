// The picture: levels as they came, stretched for the eye. Smaller than it is, each point shows the brightest of its pixels
// (an average would lose the stars); larger, each pixel is a square, with its value written in it where there is room.

import { byId, write } from "./format.js";
import { STAR } from "./protocol.js";
import { PIXELS_ZOOM, View } from "./view.js";

const STRETCH_GAIN = 4; // asinh(gain * level) / asinh(gain * white): the first level of 8 bits has 27 % of the way to white
const GRID_FROM = 9; // CSS pixels per monitor pixel from which pixel edges are drawn
const VALUES_FROM = 22;
const MAX_RATIO = 2;
const SAME_STAR_PX = 4; // largest distance from the brightest pixel to its star
const CLIPPED_RED = 0xff4d4dff; // ABGR

const STRETCHES = {
  linear: (level, white) => level / white,
  log: (level, white) => Math.log1p(level) / Math.log1p(white),
  asinh: (level, white) => Math.asinh(STRETCH_GAIN * level) / Math.asinh(STRETCH_GAIN * white),
};

export function colourTable(stretch, white, levels, redFrom) {
  const table = new Uint32Array(levels);
  for (let level = 0; level < levels; level += 1) {
    const grey = Math.round(255 * Math.min(STRETCHES[stretch](level, white), 1));
    table[level] = level >= redFrom ? CLIPPED_RED : 0xff000000 | (grey << 16) | (grey << 8) | grey;
  }
  return table;
}

// Where each monitor pixel of a row or column falls on the canvas; -1 outside of it.
function placesOf(size, centre, scale, room) {
  const places = new Int32Array(size);
  for (let k = 0; k < size; k += 1) {
    const at = Math.floor((k - centre) * scale + room / 2);
    places[k] = at >= 0 && at < room ? at : -1;
  }
  return places;
}

export function maxPooled(levels, width, xs, ys, pooled, room) {
  pooled.fill(0);
  for (let y = 0; y < ys.length; y += 1) {
    if (ys[y] < 0) continue;
    const from = y * width;
    const to = ys[y] * room;
    for (let x = 0; x < width; x += 1) {
      const level = levels[from + x];
      if (level !== 0 && xs[x] >= 0 && level > pooled[to + xs[x]]) pooled[to + xs[x]] = level;
    }
  }
}

// How far a lit point glows in a picture that is made smaller, for faint, middling and bright ones: [dx, dy, weight] each.
const GLOWS_PX = [0, 0.55, 0.85, 1.15];

function glowKernels(ratio) {
  return GLOWS_PX.map((sigma) => {
    const reach = Math.ceil(2 * sigma * ratio);
    const kernel = [];
    for (let dy = -reach; dy <= reach; dy += 1) {
      for (let dx = -reach; dx <= reach; dx += 1) {
        const weight = Math.exp(-(dx * dx + dy * dy) / (2 * (sigma * ratio) ** 2));
        if ((dx || dy) && weight > 0.1) kernel.push([dx, dy, weight]);
      }
    }
    return kernel;
  });
}

// Brighter stars look larger: each lit point that stands out from its row lights those about it, never less than they are.
export function addGlow(pooled, width, height, table, pixels, kernels) {
  for (let k = 0; k < pooled.length; k += 1) {
    const level = pooled[k];
    if (level === 0 || (pooled[k - 1] >= level && pooled[k + 1] >= level)) continue;
    const red = table[level] === CLIPPED_RED;
    const grey = red ? 255 : table[level] & 0xff;
    const [x, y] = [k % width, Math.floor(k / width)];
    for (const [dx, dy, weight] of kernels[Math.min(grey >> 6, kernels.length - 1)]) {
      if (x + dx < 0 || x + dx >= width || y + dy < 0 || y + dy >= height) continue;
      const at = k + dy * width + dx;
      const lit = Math.round(grey * weight);
      if ((pixels[at] & 0xff) < lit) pixels[at] = 0xff000000 | (red ? lit : (lit << 16) | (lit << 8) | lit);
    }
  }
}

function identity(star) {
  return star[STAR.hip] || star[STAR.label] || null;
}

export class Picture {
  constructor(canvas, onView) {
    Object.assign(this, { canvas, levels: null, frame: null, white: 255, stretch: "asinh", redClipped: false, followed: null });
    this.context = canvas.getContext("2d");
    this.close = document.createElement("canvas");
    this.view = new View(canvas, onView);
    this.view.onHand = () => {
      this.followed = null;
    };
    this.pointer = null;
    for (const kind of ["pointermove", "pointerdown"]) {
      canvas.addEventListener(kind, (event) => this.point(event));
    }
    canvas.addEventListener("pointerleave", () => {
      this.pointer = null;
      this.tellPixel();
    });
  }

  setScreen([w, h], white) {
    this.white = white;
    this.table = null;
    this.view.setSize(w, h);
    this.canvas.parentElement.style.aspectRatio = `${w} / ${h}`;
    this.fitStage();
  }

  setStretch(stretch) {
    this.stretch = stretch;
    this.table = null;
  }

  setRedClipped(on) {
    this.redClipped = on;
    this.table = null;
  }

  show(levels, w, h, frame) {
    this.levels = levels;
    this.frame = frame;
    this.view.setSize(w, h);
    this.canvas.dataset.frame = String(frame);
  }

  // Gives the canvas as many pixels as its place on the screen has; true if the size changed.
  fitStage() {
    const box = this.canvas.parentElement.getBoundingClientRect();
    const ratio = Math.min(window.devicePixelRatio || 1, MAX_RATIO);
    const [w, h] = [Math.max(Math.round(box.width * ratio), 1), Math.max(Math.round(box.height * ratio), 1)];
    if (w === this.canvas.width && h === this.canvas.height) return false;
    const zoom = this.view.zoom;
    this.canvas.width = w;
    this.canvas.height = h;
    this.view.ratio = ratio;
    this.pooled = null;
    if (zoom !== null && zoom < this.view.fitZoom) this.view.zoom = null;
    this.view.settle();
    return true;
  }

  draw() {
    if (!this.levels) return;
    const levels = this.levels.BYTES_PER_ELEMENT === 2 ? 65536 : 256;
    if (!this.table || this.table.length !== levels) {
      this.table = colourTable(this.stretch, this.white, levels, this.redClipped ? this.white : levels);
    }
    if (this.view.scale < 1) this.drawPooled();
    else this.drawClose();
    this.tellPixel();
  }

  drawPooled() {
    const { width, height } = this.canvas;
    const { w, h, cx, cy, scale } = this.view;
    if (!this.pooled || this.pooled.length !== width * height || this.pooled.BYTES_PER_ELEMENT !== this.levels.BYTES_PER_ELEMENT) {
      this.pooled = new this.levels.constructor(width * height);
      this.image = this.context.createImageData(width, height);
      this.pixels = new Uint32Array(this.image.data.buffer);
      this.kernels = glowKernels(this.view.ratio);
    }
    maxPooled(this.levels, w, placesOf(w, cx, scale, width), placesOf(h, cy, scale, height), this.pooled, width);
    for (let k = 0; k < this.pooled.length; k += 1) this.pixels[k] = this.table[this.pooled[k]];
    addGlow(this.pooled, width, height, this.table, this.pixels, this.kernels);
    this.context.putImageData(this.image, 0, 0);
  }

  // The visible monitor pixels: left, top, columns, rows.
  seen() {
    const { w, h } = this.view;
    const [x0, y0] = this.view.toMonitor(0, 0).map((at) => Math.floor(at + 0.5));
    const [x1, y1] = this.view.toMonitor(this.canvas.width, this.canvas.height).map((at) => Math.floor(at + 0.5));
    const [left, top] = [Math.max(x0, 0), Math.max(y0, 0)];
    return [left, top, Math.min(x1, w - 1) - left + 1, Math.min(y1, h - 1) - top + 1];
  }

  drawClose() {
    const { context, canvas, view } = this;
    const [left, top, columns, rows] = this.seen();
    const image = context.createImageData(columns, rows);
    const pixels = new Uint32Array(image.data.buffer);
    for (let y = 0; y < rows; y += 1) {
      const from = (top + y) * view.w + left;
      for (let x = 0; x < columns; x += 1) pixels[y * columns + x] = this.table[this.levels[from + x]];
    }
    this.close.width = columns;
    this.close.height = rows;
    this.close.getContext("2d").putImageData(image, 0, 0);
    const [u, v] = view.toCanvas(left - 0.5, top - 0.5);
    context.clearRect(0, 0, canvas.width, canvas.height);
    context.imageSmoothingEnabled = false;
    context.drawImage(this.close, u, v, columns * view.scale, rows * view.scale);
    if (view.scale >= GRID_FROM * view.ratio) this.drawEdges(left, top, columns, rows);
  }

  // Whether the zoom is large enough for code values in the pixels.
  get hasValues() {
    return Boolean(this.levels) && this.view.scale >= VALUES_FROM * this.view.ratio;
  }

  drawEdges(left, top, columns, rows) {
    const { context, canvas, view } = this;
    context.strokeStyle = "rgba(150, 170, 200, 0.22)";
    context.lineWidth = 1;
    context.beginPath();
    for (let x = 0; x <= columns; x += 1) {
      const u = Math.round(view.toCanvas(left + x - 0.5, 0)[0]) + 0.5;
      context.moveTo(u, 0);
      context.lineTo(u, canvas.height);
    }
    for (let y = 0; y <= rows; y += 1) {
      const v = Math.round(view.toCanvas(0, top + y - 0.5)[1]) + 0.5;
      context.moveTo(0, v);
      context.lineTo(canvas.width, v);
    }
    context.stroke();
  }

  // Writes the codes on a canvas above this one, so that no overlay hides them.
  drawValues(context) {
    const { view } = this;
    const [left, top, columns, rows] = this.seen();
    const digits = String(this.white).length;
    context.font = `${Math.min(Math.floor((view.scale * 1.35) / Math.max(digits, 3)), 18 * view.ratio)}px ui-monospace, Menlo, monospace`;
    context.textAlign = "center";
    context.textBaseline = "middle";
    for (let y = top; y < top + rows; y += 1) {
      for (let x = left; x < left + columns; x += 1) {
        const level = this.levels[y * view.w + x];
        const bright = (this.table[level] & 0xff) > 140;
        context.fillStyle = level === 0 ? "rgba(150, 165, 190, 0.45)" : bright ? "#05070b" : "#e9eefb";
        const [u, v] = view.toCanvas(x, y);
        context.fillText(String(level), u, v);
      }
    }
  }

  point(event) {
    this.pointer = this.view.at(event).map((at) => Math.round(at));
    this.tellPixel();
  }

  levelAt(x, y) {
    const { w, h } = this.view;
    return this.levels && x >= 0 && y >= 0 && x < w && y < h ? this.levels[y * w + x] : null;
  }

  tellPixel() {
    const level = this.pointer ? this.levelAt(...this.pointer) : null;
    write(byId("pixel"), level === null ? "" : `(${this.pointer[0]}, ${this.pointer[1]}) px: code ${level}`);
  }

  // Zooms in on the brightest visible pixel, and then follows its star.
  showPixels(truth) {
    if (!this.levels) return;
    const [left, top, columns, rows] = this.seen();
    let best = [this.view.cx, this.view.cy];
    let most = 0;
    for (let y = top; y < top + rows; y += 1) {
      for (let x = left; x < left + columns; x += 1) {
        if (this.levels[y * this.view.w + x] > most) {
          most = this.levels[y * this.view.w + x];
          best = [x, y];
        }
      }
    }
    this.view.setZoom(PIXELS_ZOOM * this.view.ratio, best, true);
    const away = (star) => Math.hypot(star[STAR.x_px] - best[0], star[STAR.y_px] - best[1]);
    const near = (truth?.stars || []).filter((star) => away(star) < SAME_STAR_PX);
    this.followed = near.length ? identity(near[0]) : null; // stars are sorted, the brightest first
  }

  // Keeps the followed star in the middle. The picture moves by whole pixels, so that pixel edges stand still.
  follow(truth) {
    if (this.followed === null || truth?.frame !== this.frame) return;
    const star = truth.stars.find((one) => identity(one) === this.followed);
    const place = star ? [Math.round(star[STAR.x_px]), Math.round(star[STAR.y_px])] : [-1, -1];
    if (this.levelAt(...place) === null) this.followed = null;
    else this.view.centreOn(place);
  }
}
