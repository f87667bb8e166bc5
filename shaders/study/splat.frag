#version 330 core
// Other profiles than splat.frag's, for `hilstar study tradeoff`: EXP_ERF, TABLE or CENTRE.

flat in ivec2 star_pixel;
flat in vec2 star_fraction_px;
flat in float star_electrons_per_s;

out float linear_e_per_s;

#ifdef TABLE
uniform sampler2D shares;  // a pixel's share along x and along y, over the distance from the star's centre
uniform float samples_per_px;

vec2 share_of(vec2 offset_px) {
    vec2 at = abs(offset_px) * samples_per_px;
    ivec2 before = min(ivec2(at), textureSize(shares, 0).x - 2);
    vec2 between = at - vec2(before);
    vec2 left = vec2(texelFetch(shares, ivec2(before.x, 0), 0).x, texelFetch(shares, ivec2(before.y, 0), 0).y);
    vec2 right = vec2(texelFetch(shares, ivec2(before.x + 1, 0), 0).x, texelFetch(shares, ivec2(before.y + 1, 0), 0).y);
    return mix(left, right, between);
}
#endif

#ifdef EXP_ERF
uniform vec2 sigma_px;

// Abramowitz and Stegun 7.1.26: at most 1.5e-7 off, before float32.
vec4 erf4(vec4 x) {
    vec4 t = 1.0 / (1.0 + 0.3275911 * abs(x));
    vec4 series = t * (0.254829592 + t * (-0.284496736 + t * (1.421413741 + t * (-1.453152027 + t * 1.061405429))));
    return sign(x) * (1.0 - series * exp(-x * x));
}

vec2 share_of(vec2 offset_px) {
    vec4 e = erf4(vec4(offset_px - 0.5, offset_px + 0.5) / (sigma_px.xyxy * sqrt(2.0)));
    return max(0.5 * (e.zw - e.xy), 0.0);
}
#endif

#ifdef CENTRE
uniform vec2 sigma_px;

vec2 share_of(vec2 offset_px) {
    vec2 z = offset_px / sigma_px;
    return exp(-0.5 * z * z) / (sigma_px * sqrt(6.283185307179586));
}
#endif

void main() {
    vec2 share = share_of(vec2(ivec2(gl_FragCoord.xy) - star_pixel) - star_fraction_px);
    linear_e_per_s = star_electrons_per_s * share.x * share.y;
}
