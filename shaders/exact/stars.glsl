// What a star gives a pixel, and which pixels are a star's own. Part of exact.comp.

// A sprite, or one that is not there: without light.
struct Star {
    ivec2 pixel;
    vec2 fraction;
    float e_per_s;
};

Star star_of(int i) {
    i *= WORDS;
    ivec2 pixel = ivec2(sprite[i], sprite[i + 1]);
    vec2 fraction = vec2(intBitsToFloat(sprite[i + 2]), intBitsToFloat(sprite[i + 3]));
    return Star(pixel, fraction, intBitsToFloat(sprite[i + 4]));
}

ivec2 pixel_of(int i) {
    return star_of(i).pixel;
}

ivec2 offset_of(uint place) {
    return ivec2(place & 63u, place >> 6 & 63u) - 32;
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

// A pixel's level, and its change to another. Two stars change the same pixel only where both their sprites end before it.
#ifdef SUMS
const uint BITS_OF_LEVEL = uint(LEVEL_BITS), IN_WORD = 32u / BITS_OF_LEVEL;

uint level_place(ivec2 at) {
    return uint(at.y * resolution_px.x + at.x);
}

int level_at(ivec2 at) {
    uint place = level_place(at);
    return int(level_words[place / IN_WORD] >> place % IN_WORD * BITS_OF_LEVEL & (1u << BITS_OF_LEVEL) - 1u);
}

void show_level(ivec2 at, int level) {
    uint place = level_place(at), shift = place % IN_WORD * BITS_OF_LEVEL;
    atomicAnd(level_words[place / IN_WORD], ~(((1u << BITS_OF_LEVEL) - 1u) << shift));
    atomicOr(level_words[place / IN_WORD], uint(level) << shift);
}
#else
int level_at(ivec2 at) {
    return int(imageLoad(levels, at).r);
}

void show_level(ivec2 at, int level) {
    imageStore(levels, at, uvec4(level, 0u, 0u, 0u));
}
#endif

const uint NO_STEP = 0xffffffffu;

float output_of(ivec2 at) {
#ifdef UNIFORMITY
    return 1.0 / texelFetch(gain, at, 0).r;
#else
    return 1.0;
#endif
}

// A pixel's light where its lower level is taken, from what it should show, and the step to the next level, in steps from black.
vec2 step_at(uint word, ivec2 at) {
    int level = int(word >> 16);
    float step = (light_of(level + 1) - light_of(level)) * output_of(at) / light_of(1);
    return word == NO_STEP ? vec2(0.0) : vec2(float(word & 0xffffu) * (-1.0 / 65535.0), 1.0) * step;
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
#ifdef NARROW
    for (int j = 0; j < 2 * BESIDE + 1; j++) light += exp(beside[j].z) * share_at(offset - beside[j].xy);
    return light;
#else
    for (int j = 0; j < 2 * BESIDE + 1; j++) light += exp(exponent_of(j, offset));
    return light * sqrt(half_inverse_spread2.x * half_inverse_spread2.y) / PI;
#endif
}
#endif

// The light that a pixel should show, e-/s, negative where it is not this star's; `own` is what the star gives.
float asked_of(ivec2 at, float own) {
    if (!on_image(at)) return -1.0;
#ifdef SUMS
    float drawn = float(sums[at.y * resolution_px.x + at.x]) * unit_e_per_s;
#else
    float drawn = imageLoad(linear_e_per_s, at).r;
#endif
    // Two stars never own one pixel: `overrated` is the largest ratio of `own` to the star's true light in a pixel.
    // A faint star's sprite may end before its near pixels do.
    return 2.0 * own > drawn * overrated ? (drawn > 0.0 ? drawn : own) : -1.0;
}
