// Directions: unit vectors, RA and Dec, the attitude's quaternion, and the Hammer projection of the whole sky.

export const DEG = Math.PI / 180;
export const HAMMER_WIDTH = 2 * Math.SQRT2;

export function vectorOf(raDeg, decDeg) {
  const c = Math.cos(decDeg * DEG);
  return [c * Math.cos(raDeg * DEG), c * Math.sin(raDeg * DEG), Math.sin(decDeg * DEG)];
}

export function radecOf([x, y, z]) {
  return [(Math.atan2(y, x) / DEG + 360) % 360, Math.atan2(z, Math.hypot(x, y)) / DEG];
}

// The camera's axes (right, down, boresight) in ICRS: the rows of the rotation from ICRS to the camera. Scalar first.
export function axesOf([w, x, y, z]) {
  return [
    [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
    [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
    [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
  ];
}

export function toIcrs(axes, [x, y, z]) {
  return [0, 1, 2].map((k) => x * axes[0][k] + y * axes[1][k] + z * axes[2][k]);
}

export function toCam(axes, v) {
  return axes.map((axis) => axis[0] * v[0] + axis[1] * v[1] + axis[2] * v[2]);
}

export function unit(v) {
  const length = Math.hypot(...v) || 1;
  return v.map((part) => part / length);
}

export function radecRollOf(q) {
  const [right, down, boresight] = axesOf(q);
  const [ra, dec] = radecOf(boresight);
  const east = (axis) => -Math.sin(ra * DEG) * axis[0] + Math.cos(ra * DEG) * axis[1];
  return [ra, dec, (Math.atan2(east(down), -east(right)) / DEG + 360) % 360];
}

// RA 0 in the middle, growing to the left, as the sky is seen from inside; both within +-HAMMER_WIDTH and half of it, y up.
export function hammer(raDeg, decDeg) {
  const lambda = -((((raDeg % 360) + 540) % 360) - 180) * DEG;
  const c = Math.cos(decDeg * DEG);
  const scale = Math.SQRT2 / Math.sqrt(1 + c * Math.cos(lambda / 2));
  return [2 * scale * c * Math.sin(lambda / 2), scale * Math.sin(decDeg * DEG)];
}
