#version 330 core
// A star's light in one pixel. It comes after shares.glsl.
// With UNITS it is a whole number of units, within the ellipse that the star lights, as in hilstar/display/render/cpu_stars.py:
// float32 holds the sum of such lights exactly up to 2^24 units, so the codes are those of the CPU.

flat in ivec2 star_pixel;
flat in vec2 star_fraction_px;
flat in float star_electrons_per_s;
#ifdef UNITS
flat in vec2 star_reach_px;

uniform float unit_e_per_s;
uniform float most_e_per_s;  // maximum light of one star in one pixel: more is white in any case

const float LEAST_PX = 1e-6;

// As cpu_stars.py, operation by operation: codes are compared with its codes.
bool within_reach(ivec2 offset) {
    int first_y = int(ceil(star_fraction_px.y - star_reach_px.y)), last_y = int(floor(star_fraction_px.y + star_reach_px.y));
    float up = abs(float(offset.y) - star_fraction_px.y) / max(star_reach_px.y, LEAST_PX);
    float wide = star_reach_px.x * sqrt(max(1.0 - up * up, 0.0));
    int first_x = int(ceil(star_fraction_px.x - wide)), last_x = int(floor(star_fraction_px.x + wide));
    return offset.y >= first_y && offset.y <= last_y && offset.x >= first_x && offset.x <= last_x;
}
#endif

out float linear_e_per_s;

// gl_FragCoord is exact at pixel centres; gl_PointCoord is snapped to 1/256 px by some drivers.
void main() {
    ivec2 offset = ivec2(gl_FragCoord.xy) - star_pixel;
    float light = star_electrons_per_s * share_at(vec2(offset) - star_fraction_px);
#ifdef UNITS
    int units = int(min(light, most_e_per_s) / unit_e_per_s + 0.5);
    light = within_reach(offset) ? float(units) * unit_e_per_s : 0.0;
#endif
    linear_e_per_s = light;
}
