// Light to level by a table in which no bin holds more than one threshold; STEP(place) is a bin. It comes after planes.glsl.
// Bits of a positive float rise with its value, so their leading part indexes the table. A bin has its first level, and below it
// in a bin's bits and one more the lower bits of its threshold. The first bin has none.
uniform ivec4 bins[PLANES];  // bits of the smallest light of a plane's first bin, and of the largest of its last; a bin's; its place

uint level_of(float light, int k) {
    ivec4 of = bins[k];
    int bits = clamp(floatBitsToInt(light), of.x, of.y);
    uint found = STEP(of.w + ((bits - of.x) >> of.z));
    uint lower = uint(bits) & ((1u << of.z) - 1u);
    return (found >> (of.z + 1)) + uint(lower >= (found & ((2u << of.z) - 1u)));
}
