#version 430 core
// Draws a frame's stars, one per lane, each within the ellipse that it lights. With LIGHT a star adds its light to the sums of its
// pixels; of primaries, with LEVELS the sums become the nearest levels.
// On llvmpipe this takes a quarter of the time of rasterised and blended points (hilstar/display/render/star_passes.py). Three quarters of
// it are the sums' memory, lane by lane: the planes of an image are beside each other in sums and levels, TEXEL of LEVEL_BITS.
// splat.frag repeats this arithmetic operation by operation, so that points make the same levels.
// Defined before this text: FOOTPRINT, TEXEL, LEVEL_BITS. Primaries' stars (APART) are taken in an order, first those whose pixels no
// other star lights: their light becomes levels without sums.
// It comes after planes.glsl, shares.glsl and sums.glsl, and before levels.glsl.

layout(local_size_x = 32) in;

layout(std430, binding = 0) readonly buffer Sprites { int sprite[]; };  // WORDS each, as SPRITE_DTYPE, and each plane's light
#ifdef APART
layout(std430, binding = 2) readonly buffer Order { int order[]; };
uniform int alone;
uniform float reach_of_alone_per_e;  // beyond it no pixel is lit
#endif
#ifdef LEVELS
layout(std430, binding = 8) buffer Levels { uint level_words[]; };
#ifdef STEPS
layout(std140, binding = 1) uniform Steps { uvec4 steps[STEPS]; };
#define STEP(bin) steps[(bin) >> 2][(bin) & 3]
#else
layout(std430, binding = 1) readonly buffer Steps { uint steps[]; };
#define STEP(bin) steps[bin]
#endif
uint level_of(float light, int k);
#ifdef UNIFORMITY
uniform sampler2D gain;
#endif
#endif

uniform int count;
uniform ivec2 resolution_px;
uniform float most_e_per_s[PLANES];  // maximum light of one star in one pixel: more is white in any case
uniform float reach_per_e;   // a star lights an ellipse: the logarithm of this times its rate, times these squares of its axes
uniform vec2 reach_px2;
uniform vec2 margin_px;      // as in star.vert

const float LEAST_PX = 1e-6;
const int FIRST = -((FOOTPRINT - 1) / 2);

// The light of the star in plane k, in units.
#define UNITS(k) \
    int(min(of_plane[k] * share_at(vec2(x, y) - fraction OFF(k)), most_e_per_s[k]) / unit_e_per_s[k] + 0.5)

void main() {
    int i = int(gl_GlobalInvocationID.x);
#if defined(APART) && defined(LIGHT)
    i += alone;
#endif
    if (i >= count) return;
    float reached_per_e = reach_per_e;
#ifdef APART
    bool is_alone = i < alone;
    if (is_alone) reached_per_e = reach_of_alone_per_e;
    i = order[i];
#endif
    ivec2 pixel = ivec2(sprite[WORDS * i], sprite[WORDS * i + 1]);
    vec2 fraction = vec2(intBitsToFloat(sprite[WORDS * i + 2]), intBitsToFloat(sprite[WORDS * i + 3]));
    float e_per_s = intBitsToFloat(sprite[WORDS * i + 4]);
    float of_plane[PLANES];
    for (int k = 0; k < PLANES; k++) of_plane[k] = intBitsToFloat(sprite[WORDS * i + WORDS - PLANES + k]);
    vec2 reach_px = sqrt(max(log(reached_per_e * e_per_s), 0.0) * reach_px2);
    vec2 all_px = reach_px + margin_px;  // in any plane
    int first_x = max(FIRST, -pixel.x), end_x = min(FIRST + FOOTPRINT, resolution_px.x - pixel.x);
    int y = max(max(FIRST, -pixel.y), int(ceil(fraction.y - all_px.y)));
    int end_y = min(min(FIRST + FOOTPRINT, resolution_px.y - pixel.y), int(floor(fraction.y + all_px.y)) + 1);
    for (; y < end_y; y++) {
        float up = max(abs(float(y) - fraction.y) - margin_px.y, 0.0) / max(reach_px.y, LEAST_PX);
        float wide = reach_px.x * sqrt(max(1.0 - up * up, 0.0)) + margin_px.x;
        int end = min(end_x, int(floor(fraction.x + wide)) + 1);
        for (int x = max(first_x, int(ceil(fraction.x - wide))); x < end; x++) {
            ivec2 at = pixel + ivec2(x, y);
            int here = PLANES * (at.y * resolution_px.x + at.x);
#ifdef LIGHT
            for (int k = 0; k < PLANES; k++) atomicAdd(sums[here + k], UNITS(k));
#else
            int sum[PLANES];
            if (is_alone) {
                for (int k = 0; k < PLANES; k++) sum[k] = UNITS(k);
            } else {
                for (int k = 0; k < PLANES; k++) sum[k] = sums[here + k];
            }
            uvec4 shown = uvec4(0u);
            for (int k = 0; k < PLANES; k++) {
                float light = float(sum[k]) * unit_e_per_s[k];
#ifdef UNIFORMITY
                light *= texelFetch(gain, at, 0).r;
#endif
                shown[k] = level_of(light, k);
            }
            int pixel_of_levels = at.y * resolution_px.x + at.x;
#if LEVEL_BITS == 8
            level_words[pixel_of_levels] = shown.x | shown.y << 8 | shown.z << 16;
#else
            level_words[2 * pixel_of_levels] = shown.x | shown.y << 16;
            level_words[2 * pixel_of_levels + 1] = shown.z;
#endif
#endif
        }
    }
}
