#version 330 core
// One point per star, as large as its footprint.
// Image row 0 is GL's bottom row: image y and gl_FragCoord.y rise together, and read-back starts at the top of the sky.

in ivec2 pixel;
in vec2 fraction_px;
in float electrons_per_s;

uniform ivec2 resolution_px;
uniform int footprint_px;
// Fainter stars may have smaller sprites: side_px[k] where the star's rate is below below_e_per_s[k], by falling rates.
const int MAX_SIDES = 8;
uniform int sides;
uniform int side_px[MAX_SIDES];
uniform float below_e_per_s[MAX_SIDES];
uniform float sprites_per_star;
// With reach_per_e above 0 a sprite is instead as large as the ellipse that the star lights, and largest_px at most (see splat.frag).
uniform float reach_per_e;
uniform vec2 reach_px2;
uniform int largest_px;
const float MARGIN_PX = 0.001;  // of rounding: a pixel too many is left dark by splat.frag

flat out ivec2 star_pixel;
flat out vec2 star_fraction_px;
flat out float star_electrons_per_s;
flat out vec2 star_reach_px;  // half axes of the ellipse

void main() {
    star_pixel = pixel;
    star_fraction_px = fraction_px;
    star_electrons_per_s = electrons_per_s;
    // The viewport reaches footprint_px beyond every edge, because GL drops a point whose centre is outside it.
    vec2 centre_px = vec2(pixel) + (footprint_px % 2 == 1 ? 0.5 : 1.0);
    gl_Position = vec4(2.0 * (centre_px + float(footprint_px)) / vec2(resolution_px + 2 * footprint_px) - 1.0, 0.0, 1.0);
    star_reach_px = sqrt(max(log(reach_per_e * electrons_per_s), 0.0) * reach_px2);
    if (reach_per_e > 0.0) {
        float reach_px = min(max(star_reach_px.x, star_reach_px.y) + MARGIN_PX, float(largest_px));
        int around = footprint_px % 2 == 1 ? 2 * int(reach_px + 0.5) + 1 : 2 * int(reach_px) + 2;
        gl_PointSize = float(min(around, largest_px));
        return;
    }
    int side = footprint_px;
    for (int k = 0; k < sides && electrons_per_s * sprites_per_star < below_e_per_s[k]; k++) side = side_px[k];
    gl_PointSize = float(side);
}
