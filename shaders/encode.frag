#version 330 core
#ifdef IMAGES  // with which no other text comes before this one
#extension GL_ARB_shader_image_load_store : require
#endif
// Light to level: the number of thresholds at or under the pixel's light.
// With STEPS no bin of the table holds more than one threshold, so the bin's own is the only one to ask, in a block of STEPS rows,
// or for 0 in a texture (levels.glsl, which then comes last). Else the bin starts the count, which takes twice as long.
// With RISES the thresholds are the edges of another quantiser, whose shader says by those about the light whether a pixel gets the
// next level instead. They are in a block of EDGES rows where there is room.
// With UNIFORMITY each pixel's light is first multiplied by its gain.
// With IMAGES light is loaded from an image (OpenGL 4.2): on llvmpipe in two thirds of the time of a texture's texel.
// With TILE light is that of tile.glsl, and no image's.
#ifdef TILE
#define LIGHT(pixel) tile_light().x
#elif defined(IMAGES)
layout(r32f) readonly uniform image2D linear_e_per_s;
#define LIGHT(pixel) imageLoad(linear_e_per_s, pixel).r
#else
uniform sampler2D linear_e_per_s;
#define LIGHT(pixel) texelFetch(linear_e_per_s, pixel, 0).r
#endif

#ifdef STEPS
#if STEPS > 0
layout(std140) uniform Steps { uvec4 steps[STEPS]; };
#define STEP(bin) steps[(bin) >> 2][(bin) & 3]
#else
uniform usampler2D steps;             // in rows of TABLE_WIDTH
#define STEP(bin) texelFetch(steps, place(bin), 0).r
#endif
uint level_of(float light);
#else
uniform usampler2D first_code;        // level of the smallest light of each bin, in rows of TABLE_WIDTH
uniform ivec3 bins;                   // the first bin, how many follow, and bits of one
#endif
#ifdef EDGES
layout(std140) uniform Edges { vec4 edges[EDGES]; };
#define THRESHOLD(k) edges[(k) >> 2][(k) & 3]
#else
uniform sampler2D threshold_e_per_s;  // in rows of TABLE_WIDTH
#define THRESHOLD(k) texelFetch(threshold_e_per_s, place(k), 0).r
#endif
uniform int white;                    // how many thresholds there are
#ifdef UNIFORMITY
uniform sampler2D gain;
#endif
#ifdef RISES
bool rises(ivec2 pixel, float light, float low, float high);
#endif

out uint code;

const int TABLE_WIDTH_BITS = 10;
const int TABLE_WIDTH = 1 << TABLE_WIDTH_BITS;

ivec2 place(int index) {
    return ivec2(index & (TABLE_WIDTH - 1), index >> TABLE_WIDTH_BITS);
}

#ifndef STEPS
uint level_of(float light) {
    int bin = clamp((floatBitsToInt(light) >> bins.z) - bins.x, 0, bins.y);
    int k = int(texelFetch(first_code, place(bin), 0).r);
    while (k < white && light >= THRESHOLD(k)) k++;
    return uint(k);
}
#endif

void main() {
    ivec2 pixel = ivec2(gl_FragCoord.xy);
    float light = LIGHT(pixel);
#ifdef UNIFORMITY
    light *= texelFetch(gain, pixel, 0).r;
#endif
    code = level_of(light);
#ifdef RISES
    int above = int(code);
    float low = above == 0 ? 0.0 : THRESHOLD(above - 1);
    code += uint(above < white && rises(pixel, light, low, THRESHOLD(above)));
#endif
}
