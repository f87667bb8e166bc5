// The operator's controls: each sends a request to the server, shows its answer, and shows the state that the run reports, never the
// requested one.

import { byId, make, write } from "./format.js";
import { SWITCHES } from "./protocol.js";

const CONFIRM_MS = 3000;
const NAME_KEY = "hilstar.operator";

function titleOf(name) {
  return name[0].toUpperCase() + name.slice(1);
}

export class Controls {
  constructor(link) {
    Object.assign(this, { link, on: {}, faultsOn: [], armed: null, allowed: false });
    for (const name of SWITCHES) byId(`control-${name}`).addEventListener("click", () => this.press(name));
    byId("mark-form").addEventListener("submit", (event) => this.mark(event));
    byId("fault-form").addEventListener("submit", (event) => this.fault(event));
    byId("fault-name").addEventListener("change", () => this.tellFault());
    byId("operator-form").addEventListener("submit", (event) => event.preventDefault());
    const name = byId("operator-name");
    name.value = localStorage.getItem(NAME_KEY) || "";
    name.addEventListener("change", () => localStorage.setItem(NAME_KEY, name.value.trim()));
  }

  setUp({ control, faults }) {
    this.allowed = control;
    write(byId("control-state"), control ? "control on" : "read-only");
    byId("control-state").title = control ? "hilstar was started with --control: these buttons change what the monitor shows, and the ledger" : "start hilstar with --control to act from here";
    byId("control-state").dataset.state = control ? "ok" : "";
    for (const field of document.querySelectorAll(".controls-panel :is(button, input, select)")) field.disabled = !control;
    const note = byId("controls-note");
    note.hidden = control;
    write(note, control ? "" : "Read-only: start hilstar with --control to act from here.");
    byId("fault-name").replaceChildren(...(faults || []).map((fault) => new Option(fault, fault)));
    byId("fault-form").hidden = !(faults || []).length;
  }

  // Disables the controls while the run does not answer; `setUp` enables them again. Text in a field stays.
  lose() {
    this.disarm();
    this.allowed = false;
    write(byId("control-state"), "no connection");
    byId("control-state").dataset.state = "";
    for (const button of document.querySelectorAll(".controls-panel button")) button.disabled = true;
  }

  hear({ operator, ledger, faults }) {
    this.faultsOn = faults || [];
    this.tellFault();
    this.on = { ...operator, ledger: ledger !== null };
    for (const name of SWITCHES) {
      const button = byId(`control-${name}`);
      button.setAttribute("aria-pressed", String(Boolean(this.on[name])));
      if (this.armed?.name !== name) write(button, this.wordsOf(name));
    }
    const said = byId("ledger-said");
    write(said, ledger === null ? "off: nothing of this run is kept" : ledger.failing ? "cannot be written" : "records this run");
    said.dataset.state = ledger === null ? "warn" : ledger.failing ? "bad" : "ok";
  }

  // A switch shows its name, the ledger's button shows what a press does.
  wordsOf(name) {
    return name === "ledger" ? (this.on.ledger ? "Stop" : "Start") : titleOf(name);
  }

  // Blanking the sky and ending a ledger need a second press within three seconds.
  press(name) {
    if (!this.allowed) return;
    const on = !this.on[name];
    const costly = (name === "blank" && on) || (name === "ledger" && !on);
    if (costly && this.armed?.name !== name) {
      this.arm(name);
      return;
    }
    this.disarm();
    this.send(name, { on }, `${titleOf(name)} ${on ? "on" : "off"}`);
  }

  arm(name) {
    this.disarm();
    const button = byId(`control-${name}`);
    button.classList.add("armed");
    write(button, name === "blank" ? "Press again: blank" : "Press again: stop");
    this.say("Press it again within 3 s.", true);
    this.armed = { name, timer: setTimeout(() => this.disarm(), CONFIRM_MS) };
  }

  disarm() {
    if (!this.armed) return;
    clearTimeout(this.armed.timer);
    const { name } = this.armed;
    this.armed = null;
    byId(`control-${name}`).classList.remove("armed");
    write(byId(`control-${name}`), this.wordsOf(name));
    this.say("", true);
  }

  mark(event) {
    event.preventDefault();
    const field = byId("mark-text");
    const text = field.value.trim();
    if (!text) {
      this.say("Write what the mark says first.", false);
      field.focus();
      return;
    }
    this.send("mark", { text }, "Mark written").then((ok) => ok && (field.value = ""));
  }

  // While a fault is on, its button ends it: a fault without an end in the scenario would last for ever.
  tellFault() {
    const name = byId("fault-name").value;
    write(byId("control-fault"), this.faultsOn.includes(name) ? "End" : "Inject");
  }

  fault(event) {
    event.preventDefault();
    const name = byId("fault-name").value;
    const on = !this.faultsOn.includes(name);
    this.send("fault", { name, on }, `Fault ${name} ${on ? "injected" : "ended"}`);
  }

  async send(name, body, done) {
    const { ok, line } = await this.link.control(name, body, byId("operator-name").value.trim());
    this.say(ok ? `${done}.` : `${SWITCHES.includes(name) ? titleOf(name) : name}: ${line}`, ok);
    return ok;
  }

  say(line, ok) {
    const said = byId("control-said");
    write(said, line);
    said.dataset.ok = String(ok);
  }
}

// The list of keys: [key, words]; what it does stands in `act`.
export function listKeys(keys) {
  byId("shortcut-list").replaceChildren(
    ...keys.flatMap(([key, words]) => {
      const name = make("dt");
      name.append(make("kbd", "", key));
      return [name, make("dd", "", words)];
    }),
  );
}
