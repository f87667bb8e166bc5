#version 330 core
// A map of light, texel by pixel, and with COVER one of the share of what is behind that each pixel hides.

uniform sampler2D light_e_per_s;
uniform ivec2 corner_px;
uniform float times;
#ifdef COVER
uniform sampler2D cover;
#endif

out vec4 light;

void main() {
    ivec2 texel = ivec2(gl_FragCoord.xy) - corner_px;
    light = vec4(vec3(times * texelFetch(light_e_per_s, texel, 0).r), 0.0);
#ifdef COVER
    light.a = texelFetch(cover, texel, 0).r;
#endif
}
