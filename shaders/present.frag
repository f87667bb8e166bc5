#version 330 core
// Levels to the screen: their codes, turned as the optics need them, and aids for aligning the bench.
// Compiled for each orientation: on llvmpipe every branch costs at every pixel. QUARTER_TURNS, FLIP_X, FLIP_Y, STEALING, RGB, AIDS.

uniform usampler2D levels;   // with RGB those of red, else of all
#ifdef RGB
uniform usampler2D green_levels;
uniform usampler2D blue_levels;
#endif
uniform usampler2D triples;  // with bit stealing the codes of each level, in rows of TABLE_WIDTH
uniform float white;         // the largest code
uniform ivec2 size_px;       // of the image
uniform ivec2 screen_px;
uniform ivec2 cross_px;      // boresight
uniform int overlay;         // bit 0: crosshair, 1: grid, 2: blank, 3: patch
uniform uint patch_code;

out vec4 colour;

const int TABLE_WIDTH = 1024;
const int GRID_PX = 100;
const uint LINE = 96u;       // of 255: visible, but darker than a star's core

ivec2 image_pixel(ivec2 screen) {
#ifdef FLIP_X
    screen.x = screen_px.x - 1 - screen.x;
#endif
#ifdef FLIP_Y
    screen.y = screen_px.y - 1 - screen.y;
#endif
#if QUARTER_TURNS == 1
    return ivec2(screen.y, screen_px.x - 1 - screen.x);
#elif QUARTER_TURNS == 2
    return screen_px - 1 - screen;
#elif QUARTER_TURNS == 3
    return ivec2(screen_px.y - 1 - screen.y, screen.x);
#else
    return screen;
#endif
}

uvec3 codes_of(ivec2 pixel) {
    uint level = texelFetch(levels, pixel, 0).r;
#ifdef RGB
    return uvec3(level, texelFetch(green_levels, pixel, 0).r, texelFetch(blue_levels, pixel, 0).r);
#elif defined(STEALING)
    return texelFetch(triples, ivec2(int(level) % TABLE_WIDTH, int(level) / TABLE_WIDTH), 0).rgb;
#else
    return uvec3(level);
#endif
}

void main() {
    // GL counts rows from the bottom, the screen from the top.
    ivec2 screen = ivec2(gl_FragCoord.x, screen_px.y - 1 - int(gl_FragCoord.y));
    ivec2 pixel = image_pixel(screen);
    bool inside = all(lessThan(uvec2(pixel), uvec2(size_px)));  // a negative number is huge without its sign
    uvec3 codes = inside ? codes_of(pixel) : uvec3(0u);
#ifdef AIDS
    bool blank = (overlay & 4) != 0, on_patch = (overlay & 8) != 0 && !blank;
    if (on_patch) codes = uvec3(patch_code);
    if (blank) codes = uvec3(0u);
    uint line = uint(float(LINE) / 255.0 * white);
    ivec2 offset = abs(pixel - cross_px);  // in GLSL the remainder of a negative number is undefined
    bool on_line = (overlay & 2) != 0 && (offset.x % GRID_PX == 0 || offset.y % GRID_PX == 0);
    on_line = on_line || ((overlay & 1) != 0 && (offset.x == 0 || offset.y == 0));
    // On a patch as bright as a line, a dark one.
    if (on_line) codes = on_patch && patch_code >= line ? uvec3(0u) : max(codes, uvec3(line));
#endif
    colour = vec4(vec3(codes) / white, 1.0);
}
