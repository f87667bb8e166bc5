// Light to level by a table in which no bin holds more than one threshold; STEP(place) is a bin.
// Bits of a positive float rise with its value, so their leading part indexes the table. A bin has its first level, and below it
// in a bin's bits and one more the lower bits of its threshold. The first bin has none.
uniform ivec3 bins;  // bits of the smallest light of the first bin, and of the largest of the last; a bin's

uint level_of(float light) {
    int bits = clamp(floatBitsToInt(light), bins.x, bins.y);
    uint step = STEP((bits - bins.x) >> bins.z);
    uint lower = uint(bits) & ((1u << bins.z) - 1u);
    return (step >> (bins.z + 1)) + uint(lower >= (step & ((2u << bins.z) - 1u)));
}
