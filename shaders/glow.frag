#version 330 core
// Light about a direction that falls with the angle from it; after rays.glsl.

uniform vec3 direction;  // unit, image axes
uniform float peak_e_per_s;
uniform float scale_rad;
uniform float exponent;

out vec4 light;

void main() {
    vec3 seen = ray(vec2(ivec2(gl_FragCoord.xy)));
    float angle = atan(length(cross(direction, seen)), dot(direction, seen)) / scale_rad;
    light = vec4(vec3(peak_e_per_s * pow(1.0 + angle * angle, -0.5 * exponent)), 0.0);
}
