#version 330 core
// Light to level: the number of thresholds at or under the pixel's light.
// Bits of a positive float rise with its value, so their leading part indexes a table that starts the count.
// With STEPS no bin holds more than one threshold, so the bin's own is the only one to ask, in a block of STEPS rows.
// With RISES the thresholds are the edges of another quantiser, whose shader says whether a pixel gets the next level instead.
// With UNIFORMITY each pixel's light is first multiplied by its gain.
// With IMAGES light is loaded from an image (OpenGL 4.2): on llvmpipe in two thirds of the time of a texture's texel.
#ifdef IMAGES
#extension GL_ARB_shader_image_load_store : require
layout(r32f) readonly uniform image2D linear_e_per_s;
#define LIGHT(pixel) imageLoad(linear_e_per_s, pixel).r
#else
uniform sampler2D linear_e_per_s;
#define LIGHT(pixel) texelFetch(linear_e_per_s, pixel, 0).r
#endif

#ifdef STEPS
// Each bin's first level, and below it in BIN_SHIFT + 1 bits the lower bits of its threshold. The first bin has none.
layout(std140) uniform Steps { uvec4 steps[STEPS]; };
uniform int lowest;  // bits of the smallest light of the first bin, and of the largest of the last
uniform int highest;
#else
uniform sampler2D threshold_e_per_s;  // in rows of TABLE_WIDTH
uniform usampler2D first_code;        // level of the smallest light of each bin, in rows of TABLE_WIDTH
uniform int first_bin;
uniform int last_bin;
uniform int white;
#endif
#ifdef UNIFORMITY
uniform sampler2D gain;
#endif
#ifdef RISES
bool rises(ivec2 pixel, float light, float low, float high);
#endif

out uint code;

const int TABLE_WIDTH_BITS = 10;
const int TABLE_WIDTH = 1 << TABLE_WIDTH_BITS;

#ifndef STEPS
ivec2 place(int index) {
    return ivec2(index & (TABLE_WIDTH - 1), index >> TABLE_WIDTH_BITS);
}

float threshold(int k) {
    return texelFetch(threshold_e_per_s, place(k), 0).r;
}
#endif

void main() {
    ivec2 pixel = ivec2(gl_FragCoord.xy);
    float light = LIGHT(pixel);
#ifdef UNIFORMITY
    light *= texelFetch(gain, pixel, 0).r;
#endif
#ifdef STEPS
    int bits = clamp(floatBitsToInt(light), lowest, highest);
    int bin = (bits - lowest) >> BIN_SHIFT;
    uint found = steps[bin >> 2][bin & 3];
    uint lower = uint(bits) & ((1u << BIN_SHIFT) - 1u);
    code = (found >> (BIN_SHIFT + 1)) + uint(lower >= (found & ((2u << BIN_SHIFT) - 1u)));
#else
    int bin = clamp((floatBitsToInt(light) >> BIN_SHIFT) - first_bin, 0, last_bin);
    int k = int(texelFetch(first_code, place(bin), 0).r);
    while (k < white && light >= threshold(k)) k++;
#ifdef RISES
    if (k < white && rises(pixel, light, k == 0 ? 0.0 : threshold(k - 1), threshold(k))) k++;
#endif
    code = uint(k);
#endif
}
