// The connection to the run: a WebSocket that is opened again when it is lost, and HTTP requests with the token.

import { GIVES_WAY, SUBPROTOCOL, TOKEN_PROTOCOL } from "./protocol.js";

const RETRY_MS = [200, 400, 800, 1500];
const SILENT_MS = 3000; // after this time without a message the socket is closed and opened again
const GAVE_WAY_MS = 10000; // pause after the server closed this page because too many were open
const TOKEN_KEY = "hilstar.token";

// The token comes in the address once, and is taken out of it: it would stay in the history and in what is copied.
export function takeToken() {
  const given = new URLSearchParams(location.hash.slice(1)).get("token");
  if (given) {
    sessionStorage.setItem(TOKEN_KEY, given);
    history.replaceState(null, "", location.pathname + location.search);
  }
  return given || sessionStorage.getItem(TOKEN_KEY) || "";
}

export class Link {
  constructor({ onMessage, onPicture, onChange }) {
    Object.assign(this, { onMessage, onPicture, onChange, token: takeToken(), tries: 0, socket: null, want: {}, heardAt: -Infinity, refusedWhy: "" });
  }

  get open() {
    return this.socket?.readyState === WebSocket.OPEN;
  }

  connect() {
    const protocols = [SUBPROTOCOL, ...(this.token ? [TOKEN_PROTOCOL + this.token] : [])];
    const socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/live`, protocols);
    socket.binaryType = "arraybuffer";
    this.socket = socket;
    this.openedAt = performance.now();
    socket.addEventListener("open", () => {
      this.tries = 0;
      this.refusedWhy = "";
      this.openedAt = performance.now();
      this.tellWant();
      this.onChange();
    });
    socket.addEventListener("message", (event) => this.hear(event.data));
    socket.addEventListener("close", ({ code }) => this.again(socket, code === GIVES_WAY));
  }

  hear(data) {
    this.heardAt = performance.now();
    if (typeof data !== "string") this.onPicture(data);
    else this.onMessage(JSON.parse(data));
  }

  again(socket, gaveWay = false) {
    if (socket !== this.socket) return;
    this.socket = null;
    if (gaveWay) this.refusedWhy = `too many pages are open, and this one gave way to a newer one; it comes back in ${GAVE_WAY_MS / 1000}\u00a0s`;
    this.onChange();
    const wait = gaveWay ? GAVE_WAY_MS : RETRY_MS[Math.min(this.tries, RETRY_MS.length - 1)];
    this.tries += 1;
    if (this.tries === 2) this.askWhy();
    setTimeout(() => this.connect(), wait);
  }

  // A browser does not tell a page why a WebSocket was refused; an HTTP request gets the reason.
  async askWhy() {
    try {
      const answer = await this.get("/state");
      this.refusedWhy = answer.status === 401 ? "this address needs its token: open the one that hilstar printed, with #token=" : "";
    } catch {
      this.refusedWhy = "";
    }
    this.onChange();
  }

  // To be called often: closes a socket without messages, so that the page connects again after the server froze.
  check() {
    const socket = this.socket;
    const since = Math.max(this.heardAt, this.openedAt || 0);
    if (socket && performance.now() - since > SILENT_MS) {
      this.again(socket);
      socket.close();
    }
  }

  ask(want) {
    Object.assign(this.want, want);
    this.tellWant();
  }

  tellWant() {
    if (this.open) this.socket.send(JSON.stringify({ want: this.want }));
  }

  headers(more = {}) {
    return this.token ? { ...more, Authorization: `Bearer ${this.token}` } : more;
  }

  get(path) {
    return fetch(path, { headers: this.headers(), cache: "no-store" });
  }

  // Sends a request; gives {ok, line}, with the server's answer in one line.
  async control(name, body, operator) {
    const headers = this.headers({ "Content-Type": "application/json" });
    if (operator) headers["X-Operator"] = encodeURIComponent(operator);
    try {
      const answer = await fetch(`/control/${name}`, { method: "POST", headers, body: JSON.stringify(body) });
      const text = await answer.text();
      return { ok: answer.ok, line: lineOf(text) || `answer ${answer.status}` };
    } catch {
      return { ok: false, line: "no answer from hilstar" };
    }
  }
}

function lineOf(text) {
  try {
    const said = JSON.parse(text);
    return String(said.error ?? said.detail ?? said.line ?? "");
  } catch {
    return text.slice(0, 300);
  }
}
