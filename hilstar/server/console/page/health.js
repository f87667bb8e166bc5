// Shows whether the sky is right, since when, and why not, by a colour, a word and a sign.

import { byId, clock, duration, write } from "./format.js";

const SILENT_MS = 400; // without a message: with CHECK_MS the page is red within half a second
const CHECK_MS = 50;
const SIGNS = { true: "\u2713", false: "!" };
const LATE = "what is shown is the right sky; its frames come too seldom";

export class Health {
  constructor(link, onChange) {
    Object.assign(this, { link, onChange, said: null, serverMs: NaN, saidAt: -Infinity, ok: null, lostUtc: null, bench: "", session: false, focus: null, missed: 0, lately: 0 });
    setInterval(() => this.check(), CHECK_MS);
  }

  hear({ utc, health, counts, focus }) {
    this.focus = focus;
    this.missed = counts?.missed ?? 0;
    this.said = health;
    this.serverMs = Date.parse(utc);
    this.saidAt = performance.now();
    this.check();
  }

  // The present time of the server's clock: the browser's clock may be wrong.
  get nowMs() {
    return this.serverMs + performance.now() - this.saidAt;
  }

  // The health {ok, late, headline, reasons, since}: as the server sent it, or that no message has come for SILENT_MS.
  judge() {
    const silent = performance.now() - this.saidAt;
    if (this.said === null) return { ok: false, late: false, headline: "Connecting", reasons: this.link.refusedWhy || "no word from hilstar yet", since: null };
    if (silent > SILENT_MS) {
      const why = this.link.open ? "the connection is open, but hilstar says nothing" : this.link.refusedWhy || "the connection is lost; trying again";
      return { ok: false, late: false, headline: "No word from hilstar", reasons: `${why}. What is below is old.`, since: this.serverMs };
    }
    const { ok, late, headline, since, reasons } = this.said;
    return { ok, late, headline, reasons: late ? LATE : reasons.join("; "), since: Date.parse(since) };
  }

  get wellSaid() {
    if (this.session && this.focus) return "turn the ring until the figure is smallest";
    if (this.session) return "each step is told under Events";
    const many = (n) => `${n} ${n === 1 ? "frame" : "frames"} missed`;
    if (this.lately) return `attitude fresh; ${many(this.lately)} in the last minute`;
    return this.missed ? `attitude fresh, frames on time for a minute; ${many(this.missed)} since the start` : "attitude fresh, frames on time";
  }

  check() {
    this.link.check();
    const { ok, late, headline, reasons, since } = this.judge();
    const box = byId("health");
    const silent = headline === "No word from hilstar" || this.said === null;
    if (ok !== this.ok || box.dataset.silent !== String(silent) || box.dataset.late !== String(late)) {
      this.ok = ok;
      box.dataset.ok = String(ok);
      box.dataset.late = document.body.dataset.late = String(late);
      box.dataset.silent = String(silent);
      document.body.dataset.ok = String(ok);
      document.body.dataset.silent = String(silent);
      write(byId("health-icon"), SIGNS[ok]);
      this.onChange(ok);
    }
    write(byId("health-headline"), headline);
    write(byId("health-reasons"), ok ? this.wellSaid : reasons);
    write(byId("health-since"), Number.isFinite(since) && since !== null ? `since ${clock(since)} UTC` : "");
    write(byId("health-for"), Number.isFinite(since) && since !== null ? duration((this.nowMs - since) / 1000) : "");
    const title = `${ok ? "\u2713" : "\u2717 " + headline + ":"} ${this.bench || "hilstar"}`;
    if (document.title !== title) document.title = title;
  }
}
