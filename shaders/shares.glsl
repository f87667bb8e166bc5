// The share of a star's light in a pixel at `d` from it, px: of a Gaussian integrated over the pixel (thesis eq. 4.7), or of a
// sampled PSF, whose table has SHARE_STEPS cells to a pixel. LOG2_SHARE, where it is defined, has log2 of a pixel's share along
// x and y by its distance squared (scene/psf.py).

#ifdef SHARE_STEPS
uniform sampler2D share_table;  // in each cell the share at its corner, the steps to the next along x and y, and both

float share_at(vec2 d) {
    ivec2 cells = textureSize(share_table, 0);
    vec2 at = clamp(d * SHARE_STEPS + 0.5 * vec2(cells), vec2(0.0), vec2(cells));
    ivec2 cell = min(ivec2(at), cells - 1);
    vec2 part = at - vec2(cell);
    vec4 share = texelFetch(share_table, cell, 0);
    return share.x + share.y * part.x + (share.z + share.w * part.x) * part.y;
}
#elif defined(LOG2_SHARE)
vec2 shares_at(vec2 d) {
    return exp2(LOG2_SHARE((d * d)));
}

float share_at(vec2 d) {
    vec2 power = LOG2_SHARE((d * d));
    return exp2(power.x + power.y);
}
#else
uniform vec2 inverse_sigma_sqrt2;  // 1 / (sigma_px sqrt 2), x and y

// Rational approximation over [-4, 4] (Eigen's float erf); at most 4.4e-7 off, see tests/gpu/test_renderer.py.
// results/tradeoff.csv, psf: tables are slower and less accurate, half floats are off by 1e-3 mag and hardly faster.
vec4 erf4(vec4 value) {
    vec4 x = clamp(value, -4.0, 4.0);
    vec4 s = x * x;
    vec4 p = s * -2.72614225801306e-10 + 2.77068142495902e-08;
    p = p * s - 2.10102402082508e-06;
    p = p * s - 5.69250639462346e-05;
    p = p * s - 7.34990630326855e-04;
    p = p * s - 2.95459980854025e-03;
    p = p * s - 1.60960333262415e-02;
    vec4 q = s * -1.45660718464996e-05 - 2.13374055278905e-04;
    q = q * s - 1.68282697438203e-03;
    q = q * s - 7.37332916720468e-03;
    q = q * s - 1.42647390514189e-02;
    return x * p / q;
}

vec2 shares_at(vec2 d) {
    vec4 e = erf4(vec4(d - 0.5, d + 0.5) * inverse_sigma_sqrt2.xyxy);
    // Far out both edges round to the same value, either way by one step: no pixel may lose light.
    return 0.5 * max(e.zw - e.xy, 0.0);
}

float share_at(vec2 d) {
    vec2 share = shares_at(d);
    return share.x * share.y;
}
#endif
