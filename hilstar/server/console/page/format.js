// Numbers, times and angles as text, always with the same number of digits; and text into the page, only as text.

export const NONE = "\u2013";
const MINUS = "\u2212";

export function byId(id) {
  return document.getElementById(id);
}

export function make(tag, className = "", text = "") {
  const element = document.createElement(tag);
  if (className) element.className = className;
  if (text) element.textContent = text;
  return element;
}

// Only what changes is written: screen readers and the layout are left alone.
export function write(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

export function fixed(value, digits = 0) {
  if (value === null || value === undefined || !Number.isFinite(value)) return NONE;
  return value.toFixed(digits).replace("-", MINUS);
}

export function withUnit(value, unit, digits = 0) {
  const text = fixed(value, digits);
  return text === NONE ? NONE : `${text}\u00a0${unit}`;
}

export function count(value) {
  return value === null || value === undefined ? NONE : value.toLocaleString("en-GB").replaceAll(",", "\u202f");
}

export function bytes(value) {
  const units = ["B", "kB", "MB", "GB", "TB"];
  let size = value;
  let k = 0;
  while (size >= 1000 && k < units.length - 1) {
    size /= 1000;
    k += 1;
  }
  return `${size.toFixed(k === 0 ? 0 : 1)}\u00a0${units[k]}`;
}

// Every duration of the page: ms below 1 s (with so many digits), then s, min, h.
export function duration(seconds, digits = 0) {
  if (seconds === null || seconds === undefined || !Number.isFinite(seconds)) return "";
  const sign = seconds < 0 ? MINUS : "";
  const s = Math.abs(seconds);
  if (s < 0.9995) return `${fixed(seconds * 1000, digits)}\u00a0ms`;
  if (s < 59.95) return `${sign}${s.toFixed(s < 9.995 ? Math.max(digits, 1) : 1)}\u00a0s`;
  const whole = Math.max(Math.floor(s), 60); // the last moments of the first minute count to the second
  const minutes = Math.floor(whole / 60);
  if (minutes < 60) return `${sign}${minutes}\u00a0min ${String(whole % 60).padStart(2, "0")}\u00a0s`;
  return `${sign}${Math.floor(minutes / 60)}\u00a0h ${String(minutes % 60).padStart(2, "0")}\u00a0min`;
}

// A value with its unit; one in ms is a duration.
export function quantity(value, unit, digits = 0) {
  if (unit === "ms" && Number.isFinite(value)) return duration(value / 1000, digits);
  return withUnit(value, unit, digits).trim();
}

export function clock(utc, digits = 0) {
  const at = new Date(utc);
  if (Number.isNaN(at.getTime())) return "";
  return at.toISOString().slice(11, digits ? 20 + digits : 19);
}

function sexagesimal(value, unitMarks, seconds) {
  const scale = 10 ** seconds;
  const total = Math.round(Math.abs(value) * 3600 * scale);
  const whole = Math.floor(total / (3600 * scale));
  const minutes = Math.floor(total / (60 * scale)) % 60;
  const rest = ((total % (60 * scale)) / scale).toFixed(seconds);
  const parts = [String(whole).padStart(2, "0"), String(minutes).padStart(2, "0"), rest.padStart(seconds ? 3 + seconds : 2, "0")];
  return parts.map((part, k) => part + unitMarks[k]).join(" ");
}

export function hours(raDeg) {
  const turned = (((raDeg % 360) + 360) % 360) / 15;
  return sexagesimal(turned, ["h", "m", "s"], 2).replace(/^24h/, "00h");
}

export function degreesMinutes(decDeg) {
  return (decDeg < 0 ? MINUS : "+") + sexagesimal(decDeg, ["\u00b0", "\u2032", "\u2033"], 1);
}

export function signed(value, digits) {
  const text = fixed(value, digits);
  return value >= 0 && text !== NONE ? `+${text}` : text;
}
