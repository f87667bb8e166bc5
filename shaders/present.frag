#version 330 core
// Levels to the screen: their codes, turned as the optics want them, and what helps to align the bench.

uniform usampler2D levels;
uniform usampler2D triples;  // with bit stealing the codes of each level, in rows of TABLE_WIDTH
uniform bool stealing;
uniform float white;         // the largest code
uniform ivec2 size_px;       // of the image
uniform ivec2 screen_px;
uniform bvec2 flip;          // columns, rows of the screen
uniform int quarter_turns;   // of the image on the screen, clockwise
uniform ivec2 cross_px;      // principal point
uniform int overlay;         // bit 0: crosshair, 1: grid, 2: blank, 3: patch
uniform uint patch_code;
uniform uint marker_code;    // of the square for a photodiode, its side marker_px
uniform int marker_px;

out vec4 colour;

const int TABLE_WIDTH = 1024;
const int GRID_PX = 100;
const uint LINE = 96u;       // of 255: seen, and no star

ivec2 image_pixel(ivec2 screen) {
    if (flip.x) screen.x = screen_px.x - 1 - screen.x;
    if (flip.y) screen.y = screen_px.y - 1 - screen.y;
    if (quarter_turns == 1) return ivec2(screen.y, screen_px.x - 1 - screen.x);
    if (quarter_turns == 2) return screen_px - 1 - screen;
    if (quarter_turns == 3) return ivec2(screen_px.y - 1 - screen.y, screen.x);
    return screen;
}

uvec3 codes_of(uint level) {
    if (!stealing) return uvec3(level);
    return texelFetch(triples, ivec2(int(level) % TABLE_WIDTH, int(level) / TABLE_WIDTH), 0).rgb;
}

void main() {
    // GL counts rows from the bottom, the screen from the top.
    ivec2 screen = ivec2(gl_FragCoord.x, screen_px.y - 1 - int(gl_FragCoord.y));
    ivec2 pixel = image_pixel(screen);
    bool inside = all(greaterThanEqual(pixel, ivec2(0))) && all(lessThan(pixel, size_px));
    uvec3 codes = inside ? codes_of(texelFetch(levels, pixel, 0).r) : uvec3(0u);
    if ((overlay & 4) != 0) codes = uvec3(0u);
    uint line = uint(float(LINE) / 255.0 * white);
    ivec2 offset = pixel - cross_px;
    if ((overlay & 2) != 0 && (offset.x % GRID_PX == 0 || offset.y % GRID_PX == 0)) codes = max(codes, uvec3(line));
    if ((overlay & 1) != 0 && (offset.x == 0 || offset.y == 0)) codes = max(codes, uvec3(line));
    if ((overlay & 8) != 0) codes = uvec3(patch_code);
    if (marker_px > 0 && screen.x < marker_px && screen.y >= screen_px.y - marker_px) codes = uvec3(marker_code);
    colour = vec4(vec3(codes) / white, 1.0);
}
