// Several choices of a star's levels side by side, and how a pixel is decided in each. Part of exact.comp.

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

// exp(-u) within 0.03: exp itself is a fifth of the whole pass on a CPU.
float window_at(vec2 d) {
    float near = 1.0 / (1.0 + dot(d * d, half_inverse_window2) / 8.0);
    near *= near;
    near *= near;
    return near * near;
}

// What a pixel's error is multiplied by in each sum; `d` is it from the star, `off` the star from its nearest pixel.
void arms_of(uint place, vec2 d, vec2 off, float light_weight, out vec4 a, out vec4 b, out vec2 c) {
    float window = window_at(d);
    vec2 box = vec2(place >> 12 & 1023u, place >> 22) * boxes;
    a = vec4(light_weight, weights.y * d, weights.z * window);
    b = vec4(weights.w * window * d, box.x * (d + follows.xy * off));
    c = box.y * (d + follows.zw * off);
}

void arms_at(Near near, int k, out vec4 a, out vec4 b, out vec2 c) {
    arms_of(PLACE(k), vec2(offset_of(PLACE(k))) - near.star.fraction, near.off, near.light_weight, a, b, c);
}

Choice pick(bool first, Choice x, Choice y) {
    return Choice(first ? x.a : y.a, first ? x.b : y.b, first ? x.c : y.c, first ? x.square : y.square, first ? x.up : y.up);
}

Choice moved(Choice e, vec4 a, vec4 b, vec2 c, float by, float square, BITS bit) {
    return Choice(e.a + a * by, e.b + b * by, e.c + c * by, square, e.up | bit);
}

// Indices are written out: a compiler that does not unroll the loop keeps the choices in memory, at ten times the time.
#if KEPT == 8
#define OTHERS(DO) DO(1) DO(2) DO(3) DO(4) DO(5) DO(6) DO(7)
#define NEXT_TO_EACH(DO) DO(0, 1) DO(2, 3) DO(4, 5) DO(6, 7)
#define TWO_APART(DO) DO(0, 2) DO(1, 3) DO(4, 6) DO(5, 7)
#define FOUR_APART(DO) DO(0, 4) DO(1, 5) DO(2, 6) DO(3, 7)
#else
#define OTHERS(DO) DO(1) DO(2) DO(3)
#define NEXT_TO_EACH(DO) DO(0, 1) DO(2, 3)
#define TWO_APART(DO) DO(0, 2) DO(1, 3)
#endif
#define EACH(DO) DO(0) OTHERS(DO)

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
    uint here = PLACE(K); \
    vec2 step = step_at(step_of[K], near.star.pixel + offset_of(here)); \
    float s = step.x, t = step.y; \
    vec4 a, b; \
    vec2 c; \
    arms_of(here, vec2(offset_of(here)) - near.star.fraction, near.off, near.light_weight, a, b, c); \
    float aa = dot(a, a) + dot(b, b) + dot(c, c); \
    BITS bit = bit_of(K); \
    float lower[KEPT], rise[KEPT]; \
    EACH(LOWER) \
    PAIRS(KEEP_THE_BETTER) }
