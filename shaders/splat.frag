#version 330 core
// The share of a star's light in one pixel: a Gaussian integrated over the pixel (thesis eq. 4.7).

flat in ivec2 star_pixel;
flat in vec2 star_fraction_px;
flat in float star_electrons_per_s;

out float linear_e_per_s;

// LOG2_SHARE, where it is defined, has log2 of a pixel's share along x and y by its distance squared (scene/psf.py).
#ifndef LOG2_SHARE
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
#endif

void main() {
    // gl_FragCoord is exact at pixel centres; gl_PointCoord is snapped to 1/256 px by some drivers.
    vec2 offset_px = vec2(ivec2(gl_FragCoord.xy) - star_pixel) - star_fraction_px;
#ifdef LOG2_SHARE
    vec2 power = LOG2_SHARE((offset_px * offset_px));
    linear_e_per_s = star_electrons_per_s * exp2(power.x + power.y);
#else
    vec4 edges = vec4(offset_px - 0.5, offset_px + 0.5) * inverse_sigma_sqrt2.xyxy;
    vec4 e = erf4(edges);
    // Far out both edges round to the same value, either way by one step: no pixel may lose light.
    vec2 share = max(e.zw - e.xy, 0.0);
    linear_e_per_s = star_electrons_per_s * 0.25 * share.x * share.y;
#endif
}
