#version 430 core
// `exact`: for each star, or stretch of a path, which of the two levels about its light each pixel takes. hilstar/monitor/exact.py
// is the same in NumPy and says how; the ten sums are those of hilstar/monitor/balance.py.
// It comes after the linear image and its nearest levels, and changes those levels. A pixel is the star's that gives more than half
// of its light, so no pixel is written by two.
// With TEMPORAL a star begins with what it left in the frame before (hilstar/monitor/temporal.py).
// Defined before this text: LEVELS (r8ui or r16ui), NEAR, the most pixels that are chosen, SIZE and FIRST, a footprint's pixels along
// an axis and the first of them from the star's; and exact/inputs.glsl, exact/stars.glsl and exact/choices.glsl.
// On a CPU what is read costs most: a word for a pixel's place, once, and images rather than textures. And a branch costs both its
// sides there, since eight stars go together: so nothing is decided by the number of a pixel, and loops end where a star's do.

layout(local_size_x = 32) in;

// Choose the levels of one sprite; `carried` is what it has to make up for, and what is returned is what it leaves. Where all
// steps are equal it has `phase` of one in hand. `of_light` is the light of the whole star.
Sums choose(Star star, float of_light, Sums carried, float phase) {
    ivec2 pixel = star.pixel;
    vec2 fraction = star.fraction;
    ivec2 cell = clamp(ivec2((fraction + odd) * float(PHASES)), 0, PHASES - 1);
    int first = (cell.y * PHASES + cell.x) * footprint;
    float unit = light_of(1);
    float white_e_per_s = light_of(white);
    int reach = clamp(int(reach_px2 * log(max(of_light * reach_per_e, 1.0))), fewest, NEAR);

#ifdef PATHS
    uint place[NEAR + 2];
#define PLACE(k) place[k]
#else
#define PLACE(k) ORDER_AT(first + (k))
#endif
    uint step_of[NEAR + 2];  // the lower level, and in 16 bits how much of the step to the next the light is above it
    BITS rounded_up = BITS(0u);
    vec3 seen = vec3(0.0);  // own light and moments on the image, in this star's pixels and others'
    float largest = 0.0, smallest = NONE, lowest = 0.0;
#ifdef PATHS
    int mine = 0;
    for (int k = 0; k < reach; k++) {
        uint here = ORDER_AT(first + k);
        if (nearest_in_path(vec2(offset_of(here)))) place[mine++] = here;
    }
#else
    int mine = reach;
#endif
    for (int k = 0; k < mine; k++) {
        ivec2 offset = offset_of(PLACE(k));
        ivec2 at = pixel + offset;
#ifdef PATHS
        float own = path_light_at(vec2(offset));
#else
        vec2 d = vec2(offset) - fraction;
        float own = star.e_per_s * share_at(d);
        if (on_image(at)) seen += own * vec3(1.0, d);
#endif
        uint word = NO_STEP;
        float asked = asked_of(at, own);
        if (asked >= 0.0) {
            float factor = output_of(at) / unit;
            asked = min(asked / output_of(at), white_e_per_s);
            int level = int(imageLoad(levels, at).r);
            bool above = light_of(level) > asked;
            if (above) rounded_up |= bit_of(k);
            level -= int(above);
            float low = light_of(level), step = light_of(level + 1) - low;
            if (step > 0.0) {
                word = uint(level) << 16 | uint(clamp((asked - low) / step, 0.0, 1.0) * 65535.0 + 0.5);
                lowest += (low - asked) * factor;
                smallest = min(smallest, step * factor);
                largest = max(largest, step * factor);
            }
        }
        step_of[k] = word;
    }
#ifdef TEMPORAL
    float limit = MAX_CARRIED_STEPS * largest;  // a star that cannot make up for it saves nothing up
    carried = Sums(clamp(carried.a, -limit, limit), clamp(carried.b, -limit, limit), clamp(carried.c, -limit, limit));
#endif
    vec3 error = carried.a.xyz;
#ifndef PATHS
    for (int k = reach; k < footprint; k++) {
        ivec2 offset = offset_of(ORDER_AT(first + k));
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
        error += (light_of(int(imageLoad(levels, at).r)) - min(asked / factor, white_e_per_s)) * factor / unit * arm;
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
#ifdef PATHS
        place[k] = 0u;
#endif
        step_of[k] = NO_STEP;
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
            if (step_of[k] == NO_STEP || has_bit(best.up, k) == rise) continue;
            vec4 a, b;
            vec2 c;
            arms_of(PLACE(k), vec2(offset_of(PLACE(k))) - fraction, off, light_weight, a, b, c);
            float t = step_at(step_of[k], pixel + offset_of(PLACE(k))).y;
            float by = rise ? t : -t;
            float more = by * (2.0 * (dot(a, best.a) + dot(b, best.b) + dot(c, best.c)) + by * (dot(a, a) + dot(b, b) + dot(c, c)));
            turned = more < least ? k : turned;
            least = min(more, least);
        }
        if (least < NONE) {
            vec4 a, b;
            vec2 c;
            arms_of(PLACE(turned), vec2(offset_of(PLACE(turned))) - fraction, off, light_weight, a, b, c);
            float t = step_at(step_of[turned], pixel + offset_of(PLACE(turned))).y;
            best = moved(best, a, b, c, rise ? t : -t, best.square, BITS(0u));
            best.up ^= bit_of(turned);
        }
    }
    // Only the pixels that are not as they were rounded.
#define STORE(BITS_OF, FROM) \
    for (uint turned = best.up BITS_OF ^ rounded_up BITS_OF; turned != 0u; turned &= turned - 1u) { \
        int k = findLSB(turned) + FROM; \
        imageStore(levels, pixel + offset_of(PLACE(k)), uvec4((step_of[k] >> 16) + uint(has_bit(best.up, k)))); }
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
