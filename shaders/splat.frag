#version 330 core
// A star's light in one pixel. It comes after shares.glsl.

flat in ivec2 star_pixel;
flat in vec2 star_fraction_px;
flat in float star_electrons_per_s;

out float linear_e_per_s;

void main() {
    // gl_FragCoord is exact at pixel centres; gl_PointCoord is snapped to 1/256 px by some drivers.
    vec2 offset_px = vec2(ivec2(gl_FragCoord.xy) - star_pixel) - star_fraction_px;
    linear_e_per_s = star_electrons_per_s * share_at(offset_px);
}
