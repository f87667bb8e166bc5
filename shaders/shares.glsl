// The share of a star's light in a pixel at `d` from it, px: a Gaussian integrated over the pixel (thesis eq. 4.7).
// LOG2_SHARE, where it is defined, has log2 of a pixel's share along x and y by its distance squared (scene/psf.py).

#ifdef LOG2_SHARE
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
