#version 330 core
// Light to code value: the number of thresholds at or under the pixel's light.
// Bits of a positive float rise with its value, so their leading part indexes a table that starts the count.

uniform sampler2D linear_e_per_s;
uniform sampler2D threshold_e_per_s;  // in rows of TABLE_WIDTH
uniform usampler2D first_code;        // codes of the smallest light of each bin, in rows of TABLE_WIDTH
uniform int bin_shift;
uniform int first_bin;
uniform int last_bin;
uniform int white;

out uint code;

const int TABLE_WIDTH = 1024;

ivec2 place(int index) {
    return ivec2(index % TABLE_WIDTH, index / TABLE_WIDTH);
}

void main() {
    float light = texelFetch(linear_e_per_s, ivec2(gl_FragCoord.xy), 0).r;
    int bin = clamp((floatBitsToInt(light) >> bin_shift) - first_bin, 0, last_bin);
    int k = int(texelFetch(first_code, place(bin), 0).r);
    while (k < white && light >= texelFetch(threshold_e_per_s, place(k), 0).r) k++;
    code = uint(k);
}
