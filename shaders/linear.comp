#version 430 core
// Adds up the linear image in a buffer (hilstar/display/render/host_image.py): the pixels of the last frame's stars become black, then this
// frame's stars add their light. A work group draws a band of rows, and each lane every eighth row of it. No two lanes write the
// same pixel, and each takes the stars in their order, so the same stars give the same bits however many threads run. Lanes in rows
// of their own wait for memory together: two columns and four rows of lanes take a seventh more time.
// Defined before this text: FOOTPRINT, BANDS; and shares.glsl.

layout(local_size_x = 8) in;

layout(std430, binding = 0) readonly buffer Sprites { int sprite[]; };  // five words each, as SPRITE_DTYPE
layout(std430, binding = 1) buffer Light { float linear_e_per_s[]; };

uniform ivec4 stars[BANDS];  // for each band: first and end of the last frame's stars, first and end of this frame's
uniform int bands;           // one, or an even number
uniform int done;            // number of stars of each band taken by earlier passes
uniform int at_once;
uniform ivec2 resolution_px;

const int FIRST = -((FOOTPRINT - 1) / 2);
const int STEP = 8;  // rows from one of a lane's to the next: a power of two

int top, bottom;  // the band's rows
int own;          // this lane's first row

// Make a star's pixels black, or add its light.
void take(int i, bool black) {
    ivec2 pixel = ivec2(sprite[5 * i], sprite[5 * i + 1]);
    vec2 fraction = vec2(intBitsToFloat(sprite[5 * i + 2]), intBitsToFloat(sprite[5 * i + 3]));
    float e_per_s = intBitsToFloat(sprite[5 * i + 4]);
    ivec2 begin = max(pixel + FIRST, ivec2(0, top));
    ivec2 end = min(pixel + FIRST + FOOTPRINT, ivec2(resolution_px.x, bottom));
    begin.y += (own - begin.y) & (STEP - 1);
    for (int y = begin.y; y < end.y; y += STEP) {
        for (int x = begin.x; x < end.x; x++) {
            int here = y * resolution_px.x + x;
            if (black) linear_e_per_s[here] = 0.0;
            else linear_e_per_s[here] += e_per_s * share_at(vec2(ivec2(x, y) - pixel) - fraction);
        }
    }
}

void main() {
    // llvmpipe gives each thread groups in a row: every second band first, so that stars close together are shared by two.
    int group = 2 * int(gl_WorkGroupID.x);
    int band = group % bands + group / bands;
    ivec4 range = stars[band];
    top = band * resolution_px.y / bands;
    bottom = (band + 1) * resolution_px.y / bands;
    own = int(gl_LocalInvocationIndex);
    int were = range.y - range.x, end_star = min(were + range.w - range.z, done + at_once);
    for (int k = done; k < min(were, end_star); k++) take(range.x + k, true);
    for (int k = max(done, were); k < end_star; k++) take(range.z + k - were, false);
}
