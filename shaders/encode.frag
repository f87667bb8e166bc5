#version 330 core
// Light to level: the number of thresholds at or under the pixel's light.
// Bits of a positive float rise with its value, so their leading part indexes a table that starts the count.
// With DITHER the thresholds are the lights of levels 1, 2, ..., and a mask decides between the level found and the next.
// With UNIFORMITY each pixel's light is first multiplied by its gain.

uniform sampler2D linear_e_per_s;
uniform sampler2D threshold_e_per_s;  // in rows of TABLE_WIDTH
uniform usampler2D first_code;        // level of the smallest light of each bin, in rows of TABLE_WIDTH
uniform int bin_shift;
uniform int first_bin;
uniform int last_bin;
uniform int white;
#ifdef UNIFORMITY
uniform sampler2D gain;
#endif
#ifdef DITHER
uniform sampler2D mask;  // thresholds between 0 and 1
uniform float shift;     // a turn of all of them, from 0 to under 1
#endif

out uint code;

const int TABLE_WIDTH = 1024;

ivec2 place(int index) {
    return ivec2(index % TABLE_WIDTH, index / TABLE_WIDTH);
}

float threshold(int k) {
    return texelFetch(threshold_e_per_s, place(k), 0).r;
}

void main() {
    ivec2 pixel = ivec2(gl_FragCoord.xy);
    float light = texelFetch(linear_e_per_s, pixel, 0).r;
#ifdef UNIFORMITY
    light *= texelFetch(gain, pixel, 0).r;
#endif
    int bin = clamp((floatBitsToInt(light) >> bin_shift) - first_bin, 0, last_bin);
    int k = int(texelFetch(first_code, place(bin), 0).r);
    while (k < white && light >= threshold(k)) k++;
#ifdef DITHER
    if (k < white) {
        float low = k == 0 ? 0.0 : threshold(k - 1);
        float turned = fract(texelFetch(mask, pixel % textureSize(mask, 0), 0).r + shift);
        if (light - low > turned * (threshold(k) - low)) k++;
    }
#endif
    code = uint(k);
}
