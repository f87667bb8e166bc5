// The map of the whole sky in the Hammer projection, with the field of view in it, which shows a wrong attitude at once.

import { DEG, HAMMER_WIDTH, axesOf, hammer, radecOf, toIcrs, unit, vectorOf } from "./sphere.js";

const OBLIQUITY_DEG = 23.4393; // IAU 2006, J2000
const GALACTIC_POLE = [192.8595, 27.1283]; // RA, Dec of the north galactic pole, ICRS (Hipparcos, ESA SP-1200, 1.5.3)
const NODES = 8; // points of the filled field from its middle to its edge
const FAINTEST = 5.5;
const LANDMARK_MAG = 3.2; // limit of the stars that are named as landmarks

function circleAbout(pole, steps = 180) {
  const [x, y, z] = pole;
  const a = unit(Math.abs(z) < 0.9 ? [y, -x, 0] : [0, z, -y]);
  const b = [y * a[2] - z * a[1], z * a[0] - x * a[2], x * a[1] - y * a[0]];
  return Array.from({ length: steps + 1 }, (_, k) => {
    const turn = (2 * Math.PI * k) / steps;
    return radecOf(a.map((part, n) => part * Math.cos(turn) + b[n] * Math.sin(turn)));
  });
}

const ECLIPTIC = circleAbout([0, -Math.sin(OBLIQUITY_DEG * DEG), Math.cos(OBLIQUITY_DEG * DEG)]);
const GALAXY = circleAbout(vectorOf(...GALACTIC_POLE));

export class Sky {
  constructor(canvas, ink) {
    Object.assign(this, { canvas, ink, stars: [], moving: [], screen: [], trail: [], q: null });
    this.context = canvas.getContext("2d");
    this.base = document.createElement("canvas");
  }

  setSky({ stars = [], moving = [], screen_cam: screen = [] }) {
    Object.assign(this, { stars, moving, screen });
    this.baseKey = "";
  }

  // Fits the canvas to its box. What does not move is drawn once, into a separate picture.
  fit() {
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    const w = Math.round(this.canvas.clientWidth * ratio);
    if (!w) return false;
    Object.assign(this, { ratio, w, h: Math.round(w / 2) });
    const key = `${w} ${this.ink.theme}`;
    if (this.canvas.width !== w || this.canvas.height !== this.h) Object.assign(this.canvas, { width: w, height: this.h });
    if (key !== this.baseKey) {
      this.baseKey = key;
      Object.assign(this.base, { width: w, height: this.h });
      this.drawBase(this.base.getContext("2d"));
    }
    return true;
  }

  at(ra, dec) {
    const [x, y] = hammer(ra, dec);
    const scale = (this.w - 4 * this.ratio) / 2 / HAMMER_WIDTH;
    return [this.w / 2 + x * scale, this.h / 2 - y * scale];
  }

  // A line on the sky, interrupted where it leaves the map on one side and enters on the other.
  line(context, points) {
    context.beginPath();
    let before = null;
    for (const [ra, dec] of points) {
      const place = this.at(ra, dec);
      context[before && this.near(before, place) ? "lineTo" : "moveTo"](...place);
      before = place;
    }
    context.stroke();
  }

  near(a, b) {
    return Math.abs(a[0] - b[0]) < this.w / 3;
  }

  drawBase(context) {
    const { ink, ratio } = this;
    context.fillStyle = ink.skyGround;
    context.beginPath();
    context.ellipse(this.w / 2, this.h / 2, this.w / 2 - 2 * ratio, this.h / 2 - ratio, 0, 0, 2 * Math.PI);
    context.fill();
    context.lineWidth = ratio * 0.8;
    context.strokeStyle = ink.skyLine;
    const steps = (from, to, by) => Array.from({ length: Math.round((to - from) / by) + 1 }, (_, k) => from + k * by);
    for (let ra = -150; ra < 180; ra += 30) this.line(context, steps(-90, 90, 3).map((dec) => [ra, dec]));
    for (const edge of [180, 179.9999]) this.line(context, steps(-90, 90, 3).map((dec) => [edge, dec]));
    for (let dec = -60; dec <= 60; dec += 30) this.line(context, steps(-179.99, 179.99, 359.98 / 120).map((ra) => [ra, dec]));
    context.strokeStyle = ink.galaxy;
    context.lineWidth = ratio * 5;
    this.line(context, GALAXY);
    context.strokeStyle = ink.ecliptic;
    context.lineWidth = ratio;
    context.setLineDash([4 * ratio, 4 * ratio]);
    this.line(context, ECLIPTIC);
    context.setLineDash([]);
    const faintest = this.w / ratio < 500 ? 4.6 : FAINTEST;
    for (const [ra, dec, magnitude] of this.stars) if (magnitude < faintest) this.dot(context, ra, dec, magnitude, ink.star);
    this.drawScale(context);
  }

  dot(context, ra, dec, magnitude, colour) {
    const share = Math.max(FAINTEST + 0.6 - magnitude, 0.25);
    context.fillStyle = colour;
    context.globalAlpha = Math.min(0.3 + 0.16 * share, 1);
    context.beginPath();
    context.arc(...this.at(ra, dec), (0.3 + 0.26 * share) * this.ratio * Math.min(Math.max(this.w / this.ratio / 420, 0.8), 1.6), 0, 2 * Math.PI);
    context.fill();
    context.globalAlpha = 1;
  }

  drawScale(context) {
    const { ratio } = this;
    context.font = `${10 * ratio}px system-ui, sans-serif`;
    context.fillStyle = this.ink.skyText;
    context.textAlign = "center";
    context.textBaseline = "middle";
    for (const ra of [300, 240, 0, 60, 120]) context.fillText(`${ra / 15}h`, ...this.at(ra, 0).map((at, k) => at + (k ? 8 * ratio : 0)));
    for (const dec of [-60, -30, 30, 60]) context.fillText(`${dec > 0 ? "+" : "\u2212"}${Math.abs(dec)}\u00b0`, ...this.at(0, dec).map((at, k) => at + (k ? 0 : 14 * ratio)));
  }

  draw() {
    if (!this.fit()) return;
    const { context, ink, ratio } = this;
    context.clearRect(0, 0, this.w, this.h);
    context.drawImage(this.base, 0, 0);
    for (const [ra, dec, magnitude] of this.moving) this.dot(context, ra, dec, Math.max(magnitude, -2), ink.moving);
    context.strokeStyle = ink.trail;
    context.lineWidth = 2 * ratio;
    if (this.trail.length > 1) this.line(context, this.trail);
    if (!this.q) return;
    const axes = axesOf(this.q);
    this.fill(axes, this.screen);
    context.strokeStyle = ink.field;
    context.lineWidth = 2 * ratio;
    this.outline(axes, this.screen);
    this.drawBoresight(axes);
  }

  outline(axes, corners) {
    if (corners.length < 3) return;
    this.line(this.context, [...corners, corners[0]].map((v) => radecOf(toIcrs(axes, v))));
  }

  // Filled in small pieces, so that a field over a pole or over the map's edge is correct.
  fill(axes, corners) {
    const { context } = this;
    context.fillStyle = this.ink.fieldFill;
    const node = (corner, k) => this.at(...radecOf(toIcrs(axes, unit(corner.map((part, n) => (part * k) / NODES + (n === 2 ? 1 - k / NODES : 0))))));
    for (let c = 0; c < corners.length; c += 1) {
      const next = corners[(c + 1) % corners.length];
      for (let k = 0; k < NODES; k += 1) {
        const piece = [node(corners[c], k), node(corners[c], k + 1), node(next, k + 1), node(next, k)];
        if (!piece.every((place) => this.near(place, piece[0]))) continue;
        context.beginPath();
        piece.forEach((place, n) => context[n ? "lineTo" : "moveTo"](...place));
        context.fill();
      }
    }
  }

  // A dot on the boresight, a line from it beyond the image's top, and a ring if the field is too small to be visible.
  drawBoresight(axes) {
    const { context, ratio } = this;
    const [u, v] = this.at(...radecOf(axes[2]));
    context.strokeStyle = context.fillStyle = this.ink.field;
    context.lineWidth = 2 * ratio;
    context.beginPath();
    context.arc(u, v, 2.5 * ratio, 0, 2 * Math.PI);
    context.fill();
    const edge = this.screen.map((corner) => this.at(...radecOf(toIcrs(axes, corner)))).map((place) => Math.hypot(place[0] - u, place[1] - v));
    const reach = Math.max(Math.min(Math.max(...edge, 0), 40 * ratio), 8 * ratio);
    if (reach <= 8 * ratio) {
      context.beginPath();
      context.arc(u, v, 14 * ratio, 0, 2 * Math.PI);
      context.stroke();
    }
    const up = this.at(...radecOf(toIcrs(axes, unit([0, -0.02, 1]))));
    const length = Math.hypot(up[0] - u, up[1] - v);
    if (!length || !this.near(up, [u, v])) return;
    const [x, y] = [((up[0] - u) / length) * (reach + 4 * ratio), ((up[1] - v) / length) * (reach + 4 * ratio)];
    context.beginPath();
    context.moveTo(u, v);
    context.lineTo(u + x, v + y);
    context.stroke();
  }

  // The named bright star that is nearest to the boresight, within the given number of degrees.
  nearest(q, withinDeg = 20) {
    const [, , boresight] = axesOf(q);
    let best = Math.cos(withinDeg * DEG);
    let found = "";
    for (const [ra, dec, magnitude, name] of this.stars) {
      const v = vectorOf(ra, dec);
      const near = v[0] * boresight[0] + v[1] * boresight[1] + v[2] * boresight[2];
      if (name && magnitude < LANDMARK_MAG && near > best) [best, found] = [near, name];
    }
    return found;
  }
}
