// What the page and its server share. Made from console/protocol.py and page_figures.py by tools/make_page_protocol.py: edit it there.

export const SUBPROTOCOL = "hilstar";
export const TOKEN_PROTOCOL = "hilstar.token.";
export const GIVES_WAY = 4013;
export const HISTORY_S = 60;
export const KEPT_EVENTS = 200;
export const SWITCHES = ["blank", "pause", "patch", "crosshair", "grid", "ledger"];
export const MESSAGE_KEYS = ["hello", "state", "history", "point", "event", "answer", "truth"];
export const STAR = {"x_px": 0, "y_px": 1, "v_mag": 2, "hip": 3, "label": 4, "clipped": 5, "colour": 6};
export const FIGURES = [
  {"panel": "pointing", "name": "Rate x, y, z", "key": "attitude.rate_deg_s", "unit": "\u00b0/s", "digits": 3, "form": "signed", "text": "{}", "none": "\u2013", "shade": ""},
  {"panel": "pointing", "name": "Quaternion", "key": "attitude.q", "unit": "", "digits": 5, "form": "signed", "text": "{}", "none": "\u2013", "shade": ""},
  {"panel": "source", "name": "First attitude", "key": "pointing", "unit": "", "digits": 0, "form": "clause", "text": "{}", "none": "\u2013", "shade": ""},
  {"panel": "source", "name": "Age at light", "key": "attitude.age_ms", "unit": "ms", "digits": 1, "form": "number", "text": "{}", "none": "\u2013", "shade": ""},
  {"panel": "source", "name": "Source", "key": "source.kind", "unit": "", "digits": 0, "form": "text", "text": "{}  {source.endpoint}", "none": "\u2013", "shade": ""},
  {"panel": "source", "name": "Clock offset", "key": "clock.offset_ms", "unit": "ms", "digits": 3, "form": "number", "text": "{} \u00b1 {clock.sigma_ms}", "none": "\u2013", "shade": ""},
  {"panel": "source", "name": "Clock drift", "key": "clock.drift_ppm", "unit": "ppm", "digits": 2, "form": "number", "text": "{}", "none": "\u2013", "shade": ""},
  {"panel": "source", "name": "Clock from", "key": "clock.synchronised", "unit": "", "digits": 0, "form": "clock", "text": "{}", "none": "\u2013", "shade": ""},
  {"panel": "run", "name": "Frames", "key": "counts.frames", "unit": "", "digits": 0, "form": "number", "text": "{}", "none": "\u2013", "shade": ""},
  {"panel": "run", "name": "Missed", "key": "counts.missed", "unit": "", "digits": 0, "form": "number", "text": "{}", "none": "\u2013", "shade": "warn"},
  {"panel": "run", "name": "Stale", "key": "counts.stale", "unit": "", "digits": 0, "form": "number", "text": "{}", "none": "\u2013", "shade": "warn"},
  {"panel": "run", "name": "Given up", "key": "counts.given_up", "unit": "", "digits": 0, "form": "number", "text": "{}", "none": "\u2013", "shade": "warn"},
  {"panel": "run", "name": "Packets", "key": "counts.accepted", "unit": "", "digits": 0, "form": "number", "text": "{} of {counts.received} accepted", "none": "\u2013", "shade": ""},
  {"panel": "run", "name": "Lost", "key": "counts.lost", "unit": "", "digits": 0, "form": "number", "text": "{}", "none": "\u2013", "shade": "warn"},
  {"panel": "run", "name": "Interval p50, p99", "key": "pacing.p50_ms", "unit": "ms", "digits": 2, "form": "number", "text": "{}, {pacing.p99_ms}", "none": "\u2013", "shade": ""},
  {"panel": "run", "name": "Jitter (sd)", "key": "pacing.sd_ms", "unit": "ms", "digits": 3, "form": "number", "text": "{}", "none": "\u2013", "shade": ""},
  {"panel": "run", "name": "Stars drawn", "key": "frame.stars", "unit": "", "digits": 0, "form": "number", "text": "{}", "none": "\u2013", "shade": ""},
  {"panel": "run", "name": "Clipped", "key": "frame.clipped", "unit": "", "digits": 0, "form": "clipped", "text": "{}", "none": "none", "shade": "warn"},
  {"panel": "run", "name": "Ledger", "key": "ledger", "unit": "", "digits": 0, "form": "ledger", "text": "{}", "none": "\u2013", "shade": ""},
  {"panel": "tracker", "name": "Mean, last minute", "key": "tracker.mean_arcsec", "unit": "\u2033", "digits": 1, "form": "signed", "text": "{}", "none": "\u2013", "shade": ""},
  {"panel": "tracker", "name": "Rms", "key": "tracker.rms_arcsec", "unit": "\u2033", "digits": 1, "form": "signed", "text": "{}", "none": "\u2013", "shade": ""},
  {"panel": "tracker", "name": "3 sigma", "key": "tracker.sigma3_arcsec", "unit": "\u2033", "digits": 1, "form": "signed", "text": "{}", "none": "\u2013", "shade": ""},
  {"panel": "tracker", "name": "Availability", "key": "tracker.availability", "unit": "%", "digits": 1, "form": "share", "text": "{} at {tracker.rate_hz Hz}", "none": "\u2013", "shade": ""},
  {"panel": "tracker", "name": "Latency", "key": "tracker.latency_ms", "unit": "ms", "digits": 1, "form": "number", "text": "{} \u00b1 {tracker.latency_sigma_ms}", "none": "\u2013", "shade": ""},
  {"panel": "tracker", "name": "Mode", "key": "tracker.mode", "unit": "", "digits": 0, "form": "text", "text": "{}", "none": "\u2013", "shade": ""},
  {"panel": "tracker", "name": "Stars", "key": "tracker.stars", "unit": "", "digits": 0, "form": "number", "text": "{}", "none": "\u2013", "shade": ""},
  {"panel": "tracker", "name": "Answers", "key": "tracker.answers", "unit": "", "digits": 0, "form": "number", "text": "{}, {tracker.invalid} without attitude", "none": "\u2013", "shade": ""},
  {"panel": "tracker", "name": "Wrong", "key": "tracker.wrong", "unit": "", "digits": 0, "form": "number", "text": "{}", "none": "\u2013", "shade": "bad"},
  {"panel": "tracker", "name": "Refused", "key": "tracker.refused", "unit": "", "digits": 0, "form": "reasons", "text": "{}", "none": "none", "shade": "warn"},
  {"panel": "tracker", "name": "Out of order", "key": "tracker.out_of_order", "unit": "", "digits": 0, "form": "number", "text": "{}", "none": "\u2013", "shade": "warn"},
  {"panel": "tracker", "name": "Line", "key": "tracker.trouble", "unit": "", "digits": 0, "form": "text", "text": "{}", "none": "in order", "shade": "warn"},
];
