// What exact.comp reads and writes.

#if NEAR <= 32
#define BITS uint
#elif NEAR <= 64
#define BITS uvec2
#else
#define BITS uvec4
#endif

layout(std430, binding = 0) readonly buffer Sprites { int sprite[]; };        // WORDS each, as SPRITE_DTYPE
// A footprint's pixels by distance, for each phase: in a block where there is room, as the light of levels in floor.glsl.
#ifdef ORDER_ROWS
layout(std140, binding = 1) uniform Order { uvec4 order_rows[ORDER_ROWS]; };
#define ORDER_AT(k) order_rows[(k) >> 2][(k) & 3]
#else
layout(std430, binding = 1) readonly buffer Order { uint order[]; };
#define ORDER_AT(k) order[k]
#endif
#ifdef PATHS
layout(std430, binding = 3) readonly buffer Stretches { ivec4 stretch[]; };   // its sprites: first, end; its path's: first, end
#else
layout(std430, binding = 3) readonly buffer Turns { int turn[]; };            // sprites, those of alike light side by side
#endif
#ifdef TEMPORAL
struct Begin {
    int before;   // the star's place in the frame before, negative where it has none
    float phase;  // of a step, where all are equal: what a new star has in hand
};
layout(std430, binding = 4) readonly buffer Begins { Begin begins[]; };
layout(std430, binding = 5) readonly buffer Before { float before[]; };       // ten sums for each star, or stretch
layout(std430, binding = 6) writeonly buffer Left { float left_sums[]; };
#else
#if BEFORE > 0
layout(std430, binding = 4) readonly buffer First { float first_sums[]; };    // ten for each star, left in the panel before
uniform vec2 makes_up;  // for how much of what it left in each panel before a star makes up here, in steps of both
#endif
#if BEFORE > 1
layout(std430, binding = 5) readonly buffer Second { float second_sums[]; };
#endif
#ifdef LEAVES
layout(std430, binding = 6) writeonly buffer Left { float left_sums[]; };
#endif
#endif
#ifdef SUMS
layout(std430, binding = 8) buffer Levels { uint level_words[]; };            // LEVEL_BITS for a pixel
#else
layout(LEVELS_FORMAT, binding = 0) uniform uimage2D levels;
layout(r32f, binding = 1) readonly uniform image2D linear_e_per_s;
#endif
#ifdef UNIFORMITY
uniform sampler2D gain;
#endif

uniform int count;
uniform int footprint;  // pixels in all
uniform float reach_px2, reach_per_e; // how many of them are chosen: as PixelOrder.reach in footprints.py
uniform int fewest;
uniform int white;
uniform float first_threshold_e_per_s;
uniform ivec2 resolution_px;
uniform float overrated; // the largest ratio of a star's light, as the shader takes it, to its true light in a pixel
uniform float odd;      // 0.5 for footprints with a middle
uniform vec2 half_inverse_window2;
#ifdef PATHS
uniform vec2 half_inverse_spread2;  // of the Gaussian and a pixel together
const float PI = 3.14159265;
#endif
uniform vec2 boxes;     // the weights of a box of 3 tracker pixels and of one of 5, of a 1023rd of a pixel in them
uniform vec4 follows;   // of the box of 3 tracker pixels along x and y, and of the one of 5
uniform vec4 weights;   // light and moments, of all and under the window
uniform float few_steps;
uniform float last_light;

const int WORDS = 5;
const int PHASES = 8;
const float NONE = 1e30;
const float SAME_STEP = 1e-4;
const float OFF = 0.6;  // of a step, where steps are equal: then one more pixel is turned

const float MAX_CARRIED_STEPS = 8.0;
