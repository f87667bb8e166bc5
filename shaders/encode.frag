#version 330 core
// Light to level, in each plane: the number of thresholds at or under the pixel's light. It comes after planes.glsl.
// With STEPS no bin of the table holds more than one threshold, so the bin's own is the only one to ask, in a block of STEPS rows,
// or for 0 in a texture (levels.glsl, which then comes last). Else the bin starts the count, which takes twice as long.
// With RISES the thresholds are the edges of another quantiser, whose shader says by those about the light whether a pixel gets the
// next level instead. They are in a block of EDGES rows where there is room.
// With UNIFORMITY each pixel's light is first multiplied by its gain.
// With IMAGES light is loaded from an image (OpenGL 4.2): on llvmpipe in two thirds of the time of a texture's texel.
// With TILE light is that of tile.glsl, and no image's.
#ifdef TILE
#define LIGHT(pixel) vec4(tile_light().x)
#elif defined(IMAGES)
layout(IMAGES) readonly uniform image2D linear_e_per_s;
#define LIGHT(pixel) imageLoad(linear_e_per_s, pixel)
#else
uniform sampler2D linear_e_per_s;
#define LIGHT(pixel) texelFetch(linear_e_per_s, pixel, 0)
#endif

#ifdef STEPS
#if STEPS > 0
layout(std140) uniform Steps { uvec4 steps[STEPS]; };
#define STEP(bin) steps[(bin) >> 2][(bin) & 3]
#else
uniform usampler2D steps;             // in rows of TABLE_WIDTH
#define STEP(bin) texelFetch(steps, place(bin), 0).r
#endif
uint level_of(float light, int k);
#else
uniform usampler2D first_code;        // level of the smallest light of each bin, in rows of TABLE_WIDTH
uniform ivec4 bins[PLANES];           // a plane's first bin, how many follow, bits of one, and its place
#endif
#ifdef EDGES
layout(std140) uniform Edges { vec4 edges[EDGES]; };
#define THRESHOLD(k) edges[(k) >> 2][(k) & 3]
#else
uniform sampler2D threshold_e_per_s;  // in rows of TABLE_WIDTH
#define THRESHOLD(k) texelFetch(threshold_e_per_s, place(k), 0).r
#endif
uniform ivec2 thresholds[PLANES];     // a plane's first, and how many
#ifdef UNIFORMITY
uniform sampler2D gain;
#endif
#ifdef RISES
bool rises(ivec2 pixel, float light, float low, float high);
#endif

#ifdef APART
out uvec4 code;
#define CODE(k) code[k]
#else
out uint code;
#define CODE(k) code
#endif

const int TABLE_WIDTH_BITS = 10;
const int TABLE_WIDTH = 1 << TABLE_WIDTH_BITS;

ivec2 place(int index) {
    return ivec2(index & (TABLE_WIDTH - 1), index >> TABLE_WIDTH_BITS);
}

#ifndef STEPS
uint level_of(float light, int plane) {
    ivec4 of = bins[plane];
    int first = thresholds[plane].x, white = thresholds[plane].y;
    int k = int(texelFetch(first_code, place(of.w + clamp((floatBitsToInt(light) >> of.z) - of.x, 0, of.y)), 0).r);
    while (k < white && light >= THRESHOLD(first + k)) k++;
    return uint(k);
}
#endif

void main() {
    ivec2 pixel = ivec2(gl_FragCoord.xy);
    vec4 light = LIGHT(pixel);
#ifdef UNIFORMITY
    light *= texelFetch(gain, pixel, 0).r;
#endif
    for (int k = 0; k < PLANES; k++) {
        uint level = level_of(light[k], k);
#ifdef RISES
        int above = thresholds[k].x + int(level);
        float low = level == 0u ? 0.0 : THRESHOLD(above - 1);
        level += uint(int(level) < thresholds[k].y && rises(pixel, light[k], low, THRESHOLD(above)));
#endif
        CODE(k) = level;
    }
}
