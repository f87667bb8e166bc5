// After encode.frag, for `dither`: a mask decides between the two levels about a pixel's light (hilstar/monitor/quantise.py).
uniform sampler2D mask;  // thresholds between 0 and 1
uniform float shift;     // a turn of all of them, from 0 to under 1

bool rises(ivec2 pixel, float light, float low, float high) {
    float turned = fract(texelFetch(mask, pixel % textureSize(mask, 0), 0).r + shift);
    return light - low > turned * (high - low);
}
