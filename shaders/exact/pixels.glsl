// A star's own pixels, and the two levels about the light of each. Part of exact.comp.

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

// What is known of a star's pixels before any is decided; lights are in steps from black.
struct Near {
    Star star;
    int first;             // of the words of its phase in ORDER
    int reach;             // pixels looked at
    int pixels;            // of them, those in `place` and `step_of`
    BITS rounded_up;       // those whose nearest level is the upper one
    float lowest;          // the error of the light with all lower levels
    float smallest, largest;  // steps
    float light_weight;
    vec2 off;              // the star from its nearest pixel
    vec3 seen;             // own light and moments on the image, in this star's pixels and others', e-/s
};

#ifdef PATHS
uint place[NEAR + 2];
#define PLACE(k) place[k]
#else
#define PLACE(k) ORDER_AT(near.first + (k))
#endif
uint step_of[NEAR + 2];  // the lower level, and in 16 bits how much of the step to the next the light is above it

#ifdef PATHS
const float FAR = 4.0;
#endif

// The light of the star, or of its path, in a pixel so far from the star's nearest one.
float own_light_at(Star star, ivec2 offset) {
#ifdef PATHS
    return path_light_at(vec2(offset));
#else
    return star.e_per_s * share_at(vec2(offset) - star.fraction);
#endif
}

// Find the two levels about the light of pixel `k`.
void look_at(inout Near near, int k) {
    ivec2 offset = offset_of(PLACE(k));
    ivec2 at = near.star.pixel + offset;
    float own = own_light_at(near.star, offset);
#ifndef PATHS
    if (on_image(at)) near.seen += own * vec3(1.0, vec2(offset) - near.star.fraction);
#endif
    step_of[k] = NO_STEP;
    float asked = asked_of(at, own);
    if (asked < 0.0) return;
    float factor = output_of(at) / light_of(1);
    asked = min(asked / output_of(at) FLOOR_LIGHT(at), light_of(white));
    int level = level_at(at);
    bool above = light_of(level) > asked;
    if (above) near.rounded_up |= bit_of(k);
    level -= int(above);
    float low = light_of(level), step = light_of(level + 1) - low;
    if (step > 0.0) {
        step_of[k] = uint(level) << 16 | uint(clamp((asked - low) / step, 0.0, 1.0) * 65535.0 + 0.5);
        near.lowest += (low - asked) * factor;
        near.smallest = min(near.smallest, step * factor);
        near.largest = max(near.largest, step * factor);
    }
}

int reach_of(float of_light) {
    return int(reach_px2 * log(max(of_light * reach_per_e, 1.0)));
}

// The pixels of a star of that light, or of a sprite of its path, and what is found there.
Near pixels_of(Star star, float of_light) {
    ivec2 cell = clamp(ivec2((star.fraction + odd) * float(PHASES)), 0, PHASES - 1);
    // As light_weight in balance.py.
    float light_weight = weights.x * (1.0 + few_steps * light_of(1) / max(star.e_per_s, 1e-3 * light_of(1)));
    vec2 off = star.fraction - round(star.fraction);
    Near near = Near(star, (cell.y * PHASES + cell.x) * footprint, 0, 0, BITS(0u), 0.0, NONE, 0.0, light_weight, off, vec3(0.0));
    near.reach = clamp(reach_of(of_light), fewest, NEAR);
#ifdef PATHS
    for (int k = 0; k < near.reach; k++) {
        uint here = ORDER_AT(near.first + k);
        if (nearest_in_path(vec2(offset_of(here)))) place[near.pixels++] = here;
    }
#else
    near.pixels = near.reach;
#endif
    for (int k = 0; k < near.pixels; k++) look_at(near, k);
    return near;
}

#ifdef PATHS
// `error` of light and moments, in steps, and that of the pixels nearest to this sprite of a path that are not chosen, most of
// them dark. A pixel with less than 1 / FAR of what the last that is chosen has is too faint to count.
vec3 error_beyond(Near near, float of_light, vec3 error) {
    int end = min(reach_of(FAR * of_light), footprint);
    for (int k = near.reach; k < end; k++) {
        ivec2 offset = offset_of(ORDER_AT(near.first + k));
        if (!nearest_in_path(vec2(offset))) continue;
        ivec2 at = near.star.pixel + offset;
        float asked = asked_of(at, own_light_at(near.star, offset));
        if (asked < 0.0) continue;
        float factor = output_of(at);
        vec3 arm = vec3(1.0, vec2(offset) - near.star.fraction);
        error += (light_of(level_at(at)) - min(asked / factor FLOOR_LIGHT(at), light_of(white))) * factor / light_of(1) * arm;
    }
    return error;
}
#else
// `error` of light and moments, in steps, and that of the pixels that are not chosen.
vec3 error_beyond(Near near, float of_light, vec3 error) {
    vec3 seen = near.seen;
    for (int k = near.reach; k < footprint; k++) {
        ivec2 offset = offset_of(PLACE(k));
        ivec2 at = near.star.pixel + offset;
        float own = own_light_at(near.star, offset);
        if (2.0 * own < first_threshold_e_per_s) break;
        vec3 arm = vec3(1.0, vec2(offset) - near.star.fraction);
        if (!on_image(at)) continue;
        seen += own * arm;
        float asked = asked_of(at, own);
        if (asked < 0.0) continue;
        float factor = output_of(at);
        error += (light_of(level_at(at)) - min(asked / factor FLOOR_LIGHT(at), light_of(white))) * factor / light_of(1) * arm;
    }
    // What lies further out stays dark.
    return error - (whole_of(near.star) - seen) / light_of(1);
}
#endif
