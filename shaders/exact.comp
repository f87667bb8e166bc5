#version 430 core
// `exact`: for each star, or stretch of a path, which of the two levels about its light each pixel takes. hilstar/monitor/exact.py
// is the same in NumPy and says how; the ten sums are those of hilstar/monitor/balance.py.
// It comes after the linear image and its nearest levels, and changes those levels. A pixel is the star's that gives more than half
// of its light, so no pixel is written by two.
// With TEMPORAL a star begins with what it left in the frame before (hilstar/monitor/temporal.py).
// Defined before this text: LEVELS (r8ui or r16ui), NEAR, the most pixels that are chosen, SIZE and FIRST, a footprint's pixels along
// an axis and the first of them from the star's.
// On a CPU what is read costs most: a word for a pixel's place, once, and images rather than textures. And a branch costs both its
// sides there, since eight stars go together: so nothing is decided by the number of a pixel, and loops end where a star's do.

layout(local_size_x = 32) in;

#if NEAR <= 32
#define BITS uint
#elif NEAR <= 64
#define BITS uvec2
#else
#define BITS uvec4
#endif

layout(std430, binding = 0) readonly buffer Sprites { int sprite[]; };        // five words each, as SPRITE_DTYPE
layout(std430, binding = 1) readonly buffer Order { uint order[]; };          // a footprint's pixels by distance, for each phase
layout(std430, binding = 2) readonly buffer Light { float light_e_per_s[]; }; // of each level, white twice
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
#endif
layout(LEVELS, binding = 0) uniform uimage2D levels;
layout(r32f, binding = 1) readonly uniform image2D linear_e_per_s;
#ifdef UNIFORMITY
uniform sampler2D gain;
#endif

uniform int count;
uniform int footprint;  // pixels in all
uniform float reach_px2, reach_per_e; // how many of them are chosen: as PixelOrder.reach in pixel_order.py
uniform int fewest;
uniform int white;
uniform float first_threshold_e_per_s;
uniform ivec2 resolution_px;
uniform float odd;      // 0.5 for footprints with a middle
uniform vec2 inverse_sigma_sqrt2;
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

const int PHASES = 8;
const int KEPT = 8;
const float NONE = 1e30;
const float SAME_STEP = 1e-4;
const float OFF = 0.6;  // of a step, where steps are equal: then one more pixel is turned

const float MAX_CARRIED_STEPS = 8.0;

// Errors of the ten sums in steps from black: those of all light and its moments plain, the others weighed.
struct Sums {
    vec4 a;  // as in a Choice
    vec4 b;
    vec2 c;
};

struct Choice {
    vec4 a;  // light, moments, light under the window
    vec4 b;  // moments under the window, moments in the smaller box
    vec2 c;  // moments in the larger box
    float square;
    BITS up;
};

// A star's shares of light along x and y in a pixel at `d` from it, and in the whole pixel: as in splat.frag.
#ifdef LOG2_SHARE
vec2 shares_at(vec2 d) {
    return exp2(LOG2_SHARE((d * d)));
}

float share_at(vec2 d) {
    vec2 power = LOG2_SHARE((d * d));
    return exp2(power.x + power.y);
}
#else
vec4 erf4(vec4 value) {
    vec4 x = clamp(value, -4.0, 4.0);
    vec4 s = x * x;
    vec4 p = s * -2.72614225801306e-10 + 2.77068142495902e-08;
    p = p * s - 2.10102402082508e-06;
    p = p * s - 5.69250639462346e-05;
    p = p * s - 7.34990630326855e-04;
    p = p * s - 2.95459980854025e-03;
    p = p * s - 1.60960333262415e-02;
    vec4 q = s * -1.45660718464996e-05 - 2.13374055278905e-04;
    q = q * s - 1.68282697438203e-03;
    q = q * s - 7.37332916720468e-03;
    q = q * s - 1.42647390514189e-02;
    return x * p / q;
}

vec2 shares_at(vec2 d) {
    vec4 e = erf4(vec4(d - 0.5, d + 0.5) * inverse_sigma_sqrt2.xyxy);
    return 0.5 * max(e.zw - e.xy, 0.0);
}

float share_at(vec2 d) {
    vec2 share = shares_at(d);
    return share.x * share.y;
}
#endif

#if NEAR <= 32
BITS bit_of(int k) {
    return 1u << k;
}

bool has_bit(BITS bits, int k) {
    return (bits & (1u << k)) != 0u;
}
#else
BITS bit_of(int k) {
    BITS bits = BITS(0u);
    bits[k >> 5] = 1u << (k & 31);
    return bits;
}

bool has_bit(BITS bits, int k) {
    return (bits[k >> 5] & (1u << (k & 31))) != 0u;
}
#endif

// A sprite, or one that is not there: without light.
struct Star {
    ivec2 pixel;
    vec2 fraction;
    float e_per_s;
};

ivec2 pixel_of(int i) {
    return ivec2(sprite[5 * i], sprite[5 * i + 1]);
}

Star star_of(int i) {
    return Star(
        pixel_of(i),
        vec2(intBitsToFloat(sprite[5 * i + 2]), intBitsToFloat(sprite[5 * i + 3])),
        intBitsToFloat(sprite[5 * i + 4]));
}

ivec2 offset_of(uint place) {
    return ivec2(place & 63u, place >> 6 & 63u) - 32;
}

// exp(-u) within 0.03: exp itself is a fifth of the whole pass on a CPU.
float window_at(vec2 d) {
    float near = 1.0 / (1.0 + dot(d * d, half_inverse_window2) / 8.0);
    near *= near;
    near *= near;
    return near * near;
}

bool on_image(ivec2 at) {
    return all(greaterThanEqual(at, ivec2(0))) && all(lessThan(at, resolution_px));
}

#ifndef PATHS
// A star's light and its moments about the star in all pixels of its footprint that are on the image: its whole light and none, but
// where the image's edge cuts it, or where it is so narrow that its pixels' middles are not where their light is (NARROW).
vec3 whole_of(Star star) {
#ifndef NARROW
    if (on_image(star.pixel + FIRST) && on_image(star.pixel + FIRST + SIZE - 1)) return vec3(star.e_per_s, 0.0, 0.0);
#endif
    vec2 light = vec2(0.0), moment = vec2(0.0);
    for (int k = FIRST; k < FIRST + SIZE; k++) {
        vec2 d = float(k) - star.fraction;
        ivec2 at = star.pixel + k;
        vec2 there = vec2(at.x >= 0 && at.x < resolution_px.x, at.y >= 0 && at.y < resolution_px.y);
        vec2 share = shares_at(d) * there;
        light += share;
        moment += share * d;
    }
    return star.e_per_s * vec3(light.x * light.y, moment.x * light.y, light.x * moment.y);
}
#endif

// What a pixel's error is multiplied by in each sum; `d` is it from the star, `off` the star from its nearest pixel.
void arms_of(uint place, vec2 d, vec2 off, float light_weight, out vec4 a, out vec4 b, out vec2 c) {
    float window = window_at(d);
    vec2 box = vec2(place >> 12 & 1023u, place >> 22) * boxes;
    a = vec4(light_weight, weights.y * d, weights.z * window);
    b = vec4(weights.w * window * d, box.x * (d + follows.xy * off));
    c = box.y * (d + follows.zw * off);
}

float output_of(ivec2 at) {
#ifdef UNIFORMITY
    return 1.0 / texelFetch(gain, at, 0).r;
#else
    return 1.0;
#endif
}

#ifdef PATHS
const int BESIDE = 1;  // sprites of a path before and after that give most of the light in the pixels nearest to a sprite

// The sprites about sprite `i` of a path: place from its pixel, and the exponent of its light, far below any where there is none.
vec3 beside[2 * BESIDE + 1];

vec3 beside_at(int i, ivec2 path, ivec2 pixel) {
    Star star = star_of(clamp(i, path.x, path.y - 1));
    bool there = i >= path.x && i < path.y;
    return vec3(vec2(star.pixel - pixel) + star.fraction, there ? log(max(star.e_per_s, 1e-30)) : -NONE);
}

void look_beside(int i, ivec2 path) {
    ivec2 pixel = pixel_of(i);
    for (int j = 0; j < 2 * BESIDE + 1; j++) beside[j] = beside_at(i + j - BESIDE, path, pixel);
}

// From the sprite before to sprite `i`.
void look_on(int i, ivec2 path) {
    ivec2 pixel = pixel_of(i);
    vec3 back = vec3(vec2(pixel_of(i - 1) - pixel), 0.0);
    for (int j = 0; j < 2 * BESIDE; j++) beside[j] = beside[j + 1] + back;
    beside[2 * BESIDE] = beside_at(i + BESIDE, path, pixel);
}

float exponent_of(int j, vec2 offset) {
    vec2 d = offset - beside[j].xy;
    return beside[j].z - dot(d * d, half_inverse_spread2);
}

// Whether a pixel is nearer to a sprite than to those before and after it in its path.
bool nearest_in_path(vec2 offset) {
    float own = exponent_of(BESIDE, offset);
    return exponent_of(BESIDE - 1, offset) < own && exponent_of(BESIDE + 1, offset) <= own;
}

// The light of a path in a pixel nearest to its sprite; a tenth or so is of sprites farther along.
float path_light_at(vec2 offset) {
    float light = 0.0;
    for (int j = 0; j < 2 * BESIDE + 1; j++) light += exp(exponent_of(j, offset));
    return light * sqrt(half_inverse_spread2.x * half_inverse_spread2.y) / PI;
}
#endif

// The light that a pixel should show, e-/s, negative where it is not this star's; `own` is what the star gives.
float asked_of(ivec2 at, float own) {
    if (!on_image(at)) return -1.0;
    float drawn = imageLoad(linear_e_per_s, at).r;
    // A faint star's sprite may end before its near pixels do.
    return 2.0 * own > drawn * 1.0001 ? (drawn > 0.0 ? drawn : own) : -1.0;
}

Choice pick(bool first, Choice x, Choice y) {
    return Choice(first ? x.a : y.a, first ? x.b : y.b, first ? x.c : y.c, first ? x.square : y.square, first ? x.up : y.up);
}

Choice moved(Choice e, vec4 a, vec4 b, vec2 c, float by, float square, BITS bit) {
    return Choice(e.a + a * by, e.b + b * by, e.c + c * by, square, e.up | bit);
}

// Indices are written out: a compiler that does not unroll the loop keeps the choices in memory, at ten times the time.
#define EIGHT(DO) DO(0) DO(1) DO(2) DO(3) DO(4) DO(5) DO(6) DO(7)
#define SEVEN(DO) DO(1) DO(2) DO(3) DO(4) DO(5) DO(6) DO(7)
#define NEXT_TO_EACH(DO) DO(0, 1) DO(2, 3) DO(4, 5) DO(6, 7)
#define TWO_APART(DO) DO(0, 2) DO(1, 3) DO(4, 6) DO(5, 7)
#define FOUR_APART(DO) DO(0, 4) DO(1, 5) DO(2, 6) DO(3, 7)

// The square of the sums where the lower level is taken, and what the step to the upper one adds to it.
#define LOWER(M) { \
    float turn = dot(a, kept[M].a) + dot(b, kept[M].b) + dot(c, kept[M].c); \
    lower[M] = kept[M].square + s * (2.0 * turn + s * aa); \
    rise[M] = t > 0.0 ? t * (2.0 * (turn + s * aa) + t * aa) : NONE; }

// Of the four choices that two of those kept lead to, keep two in their places: where both of one are better than either of the
// other, the other's place takes the second.
#define KEEP_THE_BETTER(M, N) { \
    bool rise_m = rise[M] < 0.0, rise_n = rise[N] < 0.0; \
    float better_m = lower[M] + min(rise[M], 0.0), worse_m = lower[M] + max(rise[M], 0.0); \
    float better_n = lower[N] + min(rise[N], 0.0), worse_n = lower[N] + max(rise[N], 0.0); \
    bool both_m = worse_m < better_n, both_n = worse_n < better_m; \
    bool up_m = both_n ? !rise_n : rise_m, up_n = both_m ? !rise_m : rise_n; \
    Choice in_m = pick(both_n, kept[N], kept[M]), in_n = pick(both_m, kept[M], kept[N]); \
    kept[M] = moved(in_m, a, b, c, up_m ? s + t : s, both_n ? worse_n : better_m, up_m ? bit : BITS(0u)); \
    kept[N] = moved(in_n, a, b, c, up_n ? s + t : s, both_m ? worse_m : better_n, up_n ? bit : BITS(0u)); }

// One pixel decided in all choices.
#define DECIDE(K, PAIRS) { \
    float s = short_of[K], t = step_of[K]; \
    vec4 a, b; \
    vec2 c; \
    arms_of(place[K], vec2(offset_of(place[K])) - fraction, off, light_weight, a, b, c); \
    float aa = dot(a, a) + dot(b, b) + dot(c, c); \
    BITS bit = bit_of(K); \
    float lower[KEPT], rise[KEPT]; \
    EIGHT(LOWER) \
    PAIRS(KEEP_THE_BETTER) }

// Choose the levels of one sprite; `carried` is what it has to make up for, and what is returned is what it leaves. Where all
// steps are equal it has `phase` of one in hand. `of_light` is the light of the whole star.
Sums choose(Star star, float of_light, Sums carried, float phase) {
    ivec2 pixel = star.pixel;
    vec2 fraction = star.fraction;
    ivec2 cell = clamp(ivec2((fraction + odd) * float(PHASES)), 0, PHASES - 1);
    int first = (cell.y * PHASES + cell.x) * footprint;
    float unit = light_e_per_s[1];
    float white_e_per_s = light_e_per_s[white];
    int reach = clamp(int(reach_px2 * log(max(of_light * reach_per_e, 1.0))), fewest, NEAR);

    uint place[NEAR + 2];
    float short_of[NEAR + 2];
    float step_of[NEAR + 2];
    BITS rounded_up = BITS(0u);
    vec3 seen = vec3(0.0);  // own light and moments on the image, in this star's pixels and others'
    float largest = 0.0, smallest = NONE, lowest = 0.0;
#ifdef PATHS
    int mine = 0;
    for (int k = 0; k < reach; k++) {
        uint here = order[first + k];
        if (nearest_in_path(vec2(offset_of(here)))) place[mine++] = here;
    }
#else
    int mine = reach;
    for (int k = 0; k < mine; k++) place[k] = order[first + k];
#endif
    for (int k = 0; k < mine; k++) {
        ivec2 offset = offset_of(place[k]);
        ivec2 at = pixel + offset;
#ifdef PATHS
        float own = path_light_at(vec2(offset));
#else
        vec2 d = vec2(offset) - fraction;
        float own = star.e_per_s * share_at(d);
        if (on_image(at)) seen += own * vec3(1.0, d);
#endif
        int level = 0;
        float s = 0.0, t = 0.0, asked = asked_of(at, own);
        if (asked >= 0.0) {
            float factor = output_of(at);
            asked = min(asked / factor, white_e_per_s);
            level = int(imageLoad(levels, at).r);
            float shown = light_e_per_s[level];
            bool above = shown > asked;
            float other = light_e_per_s[above ? level - 1 : level + 1];
            float low = above ? other : shown;
            factor /= unit;
            s = (low - asked) * factor;
            t = abs(other - shown) * factor;
            lowest += s;
            if (above) rounded_up |= bit_of(k);
            largest = max(largest, t);
            smallest = t > 0.0 ? min(smallest, t) : smallest;
        }
        short_of[k] = s;
        step_of[k] = t;
    }
#ifdef TEMPORAL
    float limit = MAX_CARRIED_STEPS * largest;  // a star that cannot make up for it saves nothing up
    carried = Sums(clamp(carried.a, -limit, limit), clamp(carried.b, -limit, limit), clamp(carried.c, -limit, limit));
#endif
    vec3 error = carried.a.xyz;
#ifndef PATHS
    for (int k = reach; k < footprint; k++) {
        ivec2 offset = offset_of(order[first + k]);
        ivec2 at = pixel + offset;
        vec2 d = vec2(offset) - fraction;
        float own = star.e_per_s * share_at(d);
        if (2.0 * own < first_threshold_e_per_s) break;
        vec3 arm = vec3(1.0, d);
        if (!on_image(at)) continue;
        seen += own * arm;
        float asked = asked_of(at, own);
        if (asked < 0.0) continue;
        float factor = output_of(at);
        error += (light_e_per_s[imageLoad(levels, at).r] - min(asked / factor, white_e_per_s)) * factor / unit * arm;
    }
    // What lies further out stays dark.
    error -= (whole_of(star) - seen) / unit;
#endif
    bool equal = largest > 0.0 && largest <= smallest * (1.0 + SAME_STEP);
    float hidden = 0.0;  // of the light, what no choice can show
    if (equal) {
        error.x += phase * largest;
        float all_down = lowest + error.x;
        hidden = all_down - round(all_down / largest) * largest;
        error.x -= hidden;
    }

    vec2 off = fraction - round(fraction);
    // As light_weight in balance.py.
    float light_weight = weights.x * (1.0 + few_steps * unit / max(star.e_per_s, 1e-3 * unit));
    vec3 begin = error * vec3(light_weight, weights.yy);
    float begin_square = dot(begin, begin) + carried.a.w * carried.a.w + dot(carried.b, carried.b) + dot(carried.c, carried.c);
    Choice kept[KEPT];
#define BEGIN(M) kept[M] = Choice(vec4(begin, carried.a.w), carried.b, carried.c, M == 0 ? begin_square : NONE, BITS(0u));
    EIGHT(BEGIN)
    // Three pixels at a time, the last of which may be none: those change nothing.
    for (int k = mine; k < mine + 2; k++) {
        place[k] = 0u;
        short_of[k] = 0.0;
        step_of[k] = 0.0;
    }
    for (int k = 0; k < mine; k += 3) {
        DECIDE(k, NEXT_TO_EACH)
        DECIDE(k + 1, TWO_APART)
        DECIDE(k + 2, FOUR_APART)
    }
    Choice best = kept[0];
    best.square += (last_light * last_light - 1.0) * best.a.x * best.a.x;
#define BEST(M) \
    kept[M].square += (last_light * last_light - 1.0) * kept[M].a.x * kept[M].a.x; \
    best = pick(kept[M].square < best.square, kept[M], best);
    SEVEN(BEST)
    if (equal && abs(best.a.x) > OFF * light_weight * largest) {
        bool rise = best.a.x < 0.0;
        float least = NONE;
        int turned = 0;
        for (int k = 0; k < mine; k++) {
            if (step_of[k] == 0.0 || has_bit(best.up, k) == rise) continue;
            vec4 a, b;
            vec2 c;
            arms_of(place[k], vec2(offset_of(place[k])) - fraction, off, light_weight, a, b, c);
            float by = rise ? step_of[k] : -step_of[k];
            float more = by * (2.0 * (dot(a, best.a) + dot(b, best.b) + dot(c, best.c)) + by * (dot(a, a) + dot(b, b) + dot(c, c)));
            turned = more < least ? k : turned;
            least = min(more, least);
        }
        if (least < NONE) {
            vec4 a, b;
            vec2 c;
            arms_of(place[turned], vec2(offset_of(place[turned])) - fraction, off, light_weight, a, b, c);
            best = moved(best, a, b, c, rise ? step_of[turned] : -step_of[turned], best.square, BITS(0u));
            best.up ^= bit_of(turned);
        }
    }
    for (int k = 0; k < mine; k++) {
        bool up = has_bit(best.up, k);
        if (step_of[k] == 0.0 || up == has_bit(rounded_up, k)) continue;
        ivec2 at = pixel + offset_of(place[k]);
        uint level = imageLoad(levels, at).r;
        // Of two paths that cross, each may take itself for the brighter, and both move a pixel: never beyond black and white.
        imageStore(levels, at, uvec4(up ? min(level + 1u, uint(white)) : max(level, 1u) - 1u));
    }
    vec4 plain = best.a / vec4(light_weight, weights.yy, 1.0);
    return Sums(plain + vec4(hidden, vec3(0.0)), best.b, best.c);
}

#ifdef TEMPORAL
Sums sums_before(int i) {
    if (i < 0) return Sums(vec4(0.0), vec4(0.0), vec2(0.0));
    i *= 10;
    return Sums(
        vec4(before[i], before[i + 1], before[i + 2], before[i + 3]),
        vec4(before[i + 4], before[i + 5], before[i + 6], before[i + 7]),
        vec2(before[i + 8], before[i + 9]));
}

void leave(int i, Sums sums) {
    for (int k = 0; k < 4; k++) {
        left_sums[10 * i + k] = sums.a[k];
        left_sums[10 * i + 4 + k] = sums.b[k];
    }
    for (int k = 0; k < 2; k++) left_sums[10 * i + 8 + k] = sums.c[k];
}
#endif

void main() {
    int i = int(gl_GlobalInvocationID.x);
    if (i >= count) return;
#ifndef PATHS
    i = turn[i];
#endif
#ifdef TEMPORAL
    Sums sums = sums_before(begins[i].before);
    float phase = begins[i].phase;
#else
    Sums sums = Sums(vec4(0.0), vec4(0.0), vec2(0.0));
    float phase = 0.0;
#endif
#ifdef PATHS
    ivec4 of = stretch[i];
    look_beside(of.x, of.zw);
    for (int node = of.x; node < of.y; node++) {
        if (node > of.x) {
            look_on(node, of.zw);
            sums.a.yz -= sums.a.x * (beside[BESIDE].xy - beside[BESIDE - 1].xy);
        }
        Star star = star_of(node);
        sums = choose(star, star.e_per_s * float(of.w - of.z), sums, node > of.x ? 0.0 : phase);
    }
#else
    Star star = star_of(i);
    sums = choose(star, star.e_per_s, sums, phase);
#endif
#ifdef TEMPORAL
    leave(i, sums);
#endif
}
