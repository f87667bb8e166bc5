#version 430 core
// Draws a frame's stars, one per lane, each within the ellipse that it lights. With LIGHT a star adds its light to the sums of its
// pixels; with LEVELS the sums become the nearest levels; with neither the levels become black again.
// On llvmpipe this takes a quarter of the time of rasterised and blended points (hilstar/render/star_passes.py).
// splat.frag repeats this arithmetic operation by operation, so that points make the same levels.
// Defined before this text: LEVELS_FORMAT (r8ui or r16ui), FOOTPRINT. With KEEP the sums stay for exact.comp, else they are set to 0
// when they become levels. It comes after shares.glsl and sums.glsl.

layout(local_size_x = 32) in;

layout(std430, binding = 0) readonly buffer Sprites { int sprite[]; };  // five words each, as SPRITE_DTYPE
layout(LEVELS_FORMAT, binding = 0) writeonly uniform uimage2D levels;
#ifdef LEVELS
// As in encode.frag.
#ifdef STEPS
layout(std140, binding = 1) uniform Steps { uvec4 steps[STEPS]; };
#define STEP(bin) steps[(bin) >> 2][(bin) & 3]
#else
layout(std430, binding = 1) readonly buffer Steps { uint steps[]; };
#define STEP(bin) steps[bin]
#endif
uniform int lowest;
uniform int highest;
#ifdef UNIFORMITY
uniform sampler2D gain;
#endif
#endif

uniform int count;
uniform ivec2 resolution_px;
uniform float most_e_per_s;  // maximum light of one star in one pixel: more is white in any case
uniform float reach_per_e;   // a star lights an ellipse: the logarithm of this times its rate, times these squares of its axes
uniform vec2 reach_px2;
uniform float least_reach;   // minimum of that logarithm

const int FIRST = -((FOOTPRINT - 1) / 2);

#ifdef LEVELS
uint level_of(float light) {
    int bits = clamp(floatBitsToInt(light), lowest, highest);
    uint found = STEP((bits - lowest) >> BIN_SHIFT);
    uint lower = uint(bits) & ((1u << BIN_SHIFT) - 1u);
    return (found >> (BIN_SHIFT + 1)) + uint(lower >= (found & ((2u << BIN_SHIFT) - 1u)));
}
#endif

void main() {
    int i = int(gl_GlobalInvocationID.x);
    if (i >= count) return;
    ivec2 pixel = ivec2(sprite[5 * i], sprite[5 * i + 1]);
    vec2 fraction = vec2(intBitsToFloat(sprite[5 * i + 2]), intBitsToFloat(sprite[5 * i + 3]));
    float e_per_s = intBitsToFloat(sprite[5 * i + 4]);
    vec2 reach_px = sqrt(max(log(reach_per_e * e_per_s), least_reach) * reach_px2);
    int first_x = max(FIRST, -pixel.x), end_x = min(FIRST + FOOTPRINT, resolution_px.x - pixel.x);
    int y = max(max(FIRST, -pixel.y), int(ceil(fraction.y - reach_px.y)));
    int end_y = min(min(FIRST + FOOTPRINT, resolution_px.y - pixel.y), int(floor(fraction.y + reach_px.y)) + 1);
    for (; y < end_y; y++) {
        float up = (float(y) - fraction.y) / reach_px.y;
        float wide = reach_px.x * sqrt(max(1.0 - up * up, 0.0));
        int end = min(end_x, int(floor(fraction.x + wide)) + 1);
        for (int x = max(first_x, int(ceil(fraction.x - wide))); x < end; x++) {
            ivec2 at = pixel + ivec2(x, y);
            int here = at.y * resolution_px.x + at.x;
#if defined(LIGHT)
            float light = min(e_per_s * share_at(vec2(x, y) - fraction), most_e_per_s);
            atomicAdd(sums[here], int(light / unit_e_per_s + 0.5));
#elif defined(LEVELS)
#ifdef KEEP
            int sum = sums[here];
#else
            int sum = atomicExchange(sums[here], 0);
            if (sum == 0) continue;  // shared with another star, and already done
#endif
            float light = float(sum) * unit_e_per_s;
#ifdef UNIFORMITY
            light *= texelFetch(gain, at, 0).r;
#endif
            imageStore(levels, at, uvec4(level_of(light)));
#else
#ifdef KEEP
            sums[here] = 0;
#endif
            imageStore(levels, at, uvec4(0u));
#endif
        }
    }
}
