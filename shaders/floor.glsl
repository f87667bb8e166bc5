// The light of each level, white twice, and with FLOOR the levels to whose light stars are added. It comes before exact/stars.glsl.
// In a block where there is room, which a CPU reads in half the time.
#ifdef LIGHT_ROWS
layout(std140, binding = 2) uniform Light { vec4 light_rows[LIGHT_ROWS]; };
#else
layout(std430, binding = 2) readonly buffer Light { float light_e_per_s[]; };
#endif

float light_of(int level) {
#ifdef LIGHT_ROWS
    return light_rows[level >> 2][level & 3];
#else
    return light_e_per_s[level];
#endif
}

#ifdef FLOOR
layout(LEVELS_FORMAT, binding = 1) readonly uniform uimage2D floor_levels;
#define FLOOR_LIGHT(at) + light_of(int(imageLoad(floor_levels, at).r))
#else
#define FLOOR_LIGHT(at)
#endif
