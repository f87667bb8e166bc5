#version 430 core
// `exact`: chooses, for each pixel of a star or of a stretch of a path, one of the two levels around its light.
// hilstar/display/exact.py is the same method in NumPy and explains it; the ten sums are those of hilstar/display/balance.py.
// The pass runs after the linear image and its nearest levels are drawn, and changes those levels. A pixel belongs to the star that
// gives more than half of its light, so no pixel is written by two stars.
// With TEMPORAL a star begins with the errors that it left in the frame before (hilstar/display/temporal.py).
// With BEFORE panels (1 or 2) it begins with shares of what it left in each of them; with LEAVES another panel follows.
// Defined before this text: LEVELS_FORMAT and LEVEL_BITS; KEPT (8 or 4); NEAR, the maximum number of pixels chosen; SIZE, a footprint's side in pixels;
// FIRST, its first pixel relative to the star's own; and exact/inputs.glsl, exact/stars.glsl, exact/pixels.glsl, exact/choices.glsl.
// On a CPU memory reads cost most: a pixel's place is one word, read once, and images are read faster than textures. A branch costs
// both its sides there, because eight stars run in one vector: no decision depends on a pixel's number, and loops end with the star.

layout(local_size_x = 32) in;

// Decide the star's pixels one after another, with KEPT choices side by side, and return the best. The sums begin with `error` for
// light and moments, and with `carried` for the rest.
Choice decide(Near near, vec3 error, Sums carried) {
    vec3 begin = error * vec3(near.light_weight, weights.yy);
    float begin_square = dot(begin, begin) + carried.a.w * carried.a.w + dot(carried.b, carried.b) + dot(carried.c, carried.c);
    Choice kept[KEPT];
#define BEGIN(M) kept[M] = Choice(vec4(begin, carried.a.w), carried.b, carried.c, M == 0 ? begin_square : NONE, BITS(0u));
    EACH(BEGIN)
    // A round of pixels at a time. The last of them may be padding, which changes nothing.
    for (int k = near.pixels; k < near.pixels + 2; k++) {
#ifdef PATHS
        place[k] = 0u;
#endif
        step_of[k] = NO_STEP;
    }
#if KEPT == 8
    for (int k = 0; k < near.pixels; k += 3) {
        DECIDE(k, NEXT_TO_EACH)
        DECIDE(k + 1, TWO_APART)
        DECIDE(k + 2, FOUR_APART)
    }
#else
    for (int k = 0; k < near.pixels; k += 2) {
        DECIDE(k, NEXT_TO_EACH)
        DECIDE(k + 1, TWO_APART)
    }
#endif
    Choice best = kept[0];
    best.square += (last_light * last_light - 1.0) * best.a.x * best.a.x;
#define BEST(M) \
    kept[M].square += (last_light * last_light - 1.0) * kept[M].a.x * kept[M].a.x; \
    best = pick(kept[M].square < best.square, kept[M], best);
    OTHERS(BEST)
    return best;
}

// Where all steps are equal: turn the one pixel that brings the light a step nearer at the smallest cost in the other sums.
Choice turn_one(Near near, Choice best) {
    bool rise = best.a.x < 0.0;
    float least = NONE;
    int turned = 0;
    vec4 a, b;
    vec2 c;
    for (int k = 0; k < near.pixels; k++) {
        if (step_of[k] == NO_STEP || has_bit(best.up, k) == rise) continue;
        arms_at(near, k, a, b, c);
        float by = (rise ? 1.0 : -1.0) * step_at(step_of[k], near.star.pixel + offset_of(PLACE(k))).y;
        float more = by * (2.0 * (dot(a, best.a) + dot(b, best.b) + dot(c, best.c)) + by * (dot(a, a) + dot(b, b) + dot(c, c)));
        turned = more < least ? k : turned;
        least = min(more, least);
    }
    if (least < NONE) {
        arms_at(near, turned, a, b, c);
        float by = (rise ? 1.0 : -1.0) * step_at(step_of[turned], near.star.pixel + offset_of(PLACE(turned))).y;
        best = moved(best, a, b, c, by, best.square, BITS(0u));
        best.up ^= bit_of(turned);
    }
    return best;
}

// Write only the pixels whose level is not the nearest one.
void store(Near near, BITS up) {
#define STORE(BITS_OF, FROM) \
    for (uint turned = up BITS_OF ^ near.rounded_up BITS_OF; turned != 0u; turned &= turned - 1u) { \
        int k = findLSB(turned) + FROM; \
        show_level(near.star.pixel + offset_of(PLACE(k)), int(step_of[k] >> 16) + int(has_bit(up, k))); }
#if NEAR <= 32
    STORE(, 0)
#else
    STORE([0], 0)
    STORE([1], 32)
#if NEAR > 64
    STORE([2], 64)
    STORE([3], 96)
#endif
#endif
}

// Choose the levels of one sprite and return the errors that it leaves. `carried` are the errors that it has to make up for;
// where all steps are equal, `phase` is the part of one that its light has in hand. `of_light` is the whole star's light, e-/s.
Sums choose(Star star, float of_light, Sums carried, float phase) {
    Near near = pixels_of(star, of_light);
#ifdef TEMPORAL
    float limit = MAX_CARRIED_STEPS * near.largest;  // so that a star that cannot make up for its errors does not accumulate them
    carried = Sums(clamp(carried.a, -limit, limit), clamp(carried.b, -limit, limit), clamp(carried.c, -limit, limit));
#endif
    vec3 error = error_beyond(near, of_light, carried.a.xyz);
    bool equal = near.largest > 0.0 && near.largest <= near.smallest * (1.0 + SAME_STEP);
    float hidden = 0.0;  // the part of the light that no choice can show
    if (equal) {
        error.x += phase * near.largest;
        float all_down = near.lowest + error.x;
        hidden = all_down - round(all_down / near.largest) * near.largest;
        error.x -= hidden;
    }
    Choice best = decide(near, error, carried);
    if (equal && abs(best.a.x) > OFF * near.light_weight * near.largest) best = turn_one(near, best);
    store(near, best.up);
    vec4 plain = best.a / vec4(near.light_weight, weights.yy, 1.0);
    return Sums(plain + vec4(hidden, vec3(0.0)), best.b, best.c);
}

#define SUMS_AT(OF, i) Sums( \
    vec4(OF[i], OF[i + 1], OF[i + 2], OF[i + 3]), vec4(OF[i + 4], OF[i + 5], OF[i + 6], OF[i + 7]), vec2(OF[i + 8], OF[i + 9]))

#if BEFORE > 0
Sums with_share(Sums sums, float share, Sums left) {
    return Sums(sums.a + share * left.a, sums.b + share * left.b, sums.c + share * left.c);
}
#endif

#if defined(TEMPORAL) || defined(LEAVES)
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
    Sums sums = Sums(vec4(0.0), vec4(0.0), vec2(0.0));
    float phase = 0.0;
#ifdef TEMPORAL
    int star_before = begins[i].before;
    if (star_before >= 0) sums = SUMS_AT(before, 10 * star_before);
    phase = begins[i].phase;
#endif
#if BEFORE > 0
    if (makes_up.x != 0.0) sums = with_share(sums, makes_up.x, SUMS_AT(first_sums, 10 * i));
#endif
#if BEFORE > 1
    if (makes_up.y != 0.0) sums = with_share(sums, makes_up.y, SUMS_AT(second_sums, 10 * i));
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
#if defined(TEMPORAL) || defined(LEAVES)
    leave(i, sums);
#endif
}
