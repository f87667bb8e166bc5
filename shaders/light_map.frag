#version 330 core
// A map of light, texel by pixel.

uniform sampler2D light_e_per_s;
uniform ivec2 corner_px;
uniform float times;

out vec4 light;

void main() {
    light = vec4(times * texelFetch(light_e_per_s, ivec2(gl_FragCoord.xy) - corner_px, 0).r, 0.0, 0.0, 0.0);
}
