// After encode.frag, for `dither`: a mask decides between the two levels about a pixel's light (hilstar/display/quantise.py).
uniform sampler2D mask;  // thresholds between 0 and 1; its sides are powers of two
uniform float shift;     // a turn of all of them, from 0 to under 1

bool rises(ivec2 pixel, float light, float low, float high) {
    float turned = fract(texelFetch(mask, pixel & (textureSize(mask, 0) - 1), 0).r + shift);
    return light - low > turned * (high - low);
}
