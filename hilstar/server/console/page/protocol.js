// What the page and its server share. Made from console/protocol.py by tools/make_page_protocol.py: edit it there.

export const SUBPROTOCOL = "hilstar";
export const TOKEN_PROTOCOL = "hilstar.token.";
export const GIVES_WAY = 4013;
export const HISTORY_S = 60;
export const KEPT_EVENTS = 200;
export const SWITCHES = ["blank", "pause", "patch", "crosshair", "grid", "ledger"];
export const MESSAGE_KEYS = ["hello", "state", "history", "point", "event", "answer", "truth"];
export const STAR = {"x_px": 0, "y_px": 1, "v_mag": 2, "hip": 3, "label": 4, "clipped": 5, "colour": 6};
