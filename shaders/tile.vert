#version 330 core
// A tile of the image, in pixels' edges; `rate` is the light at its corner, for tiles in which it is linear.

uniform vec2 size_px;

in vec2 place_px;
in float rate;

out float rate_here;

void main() {
    gl_Position = vec4(2.0 * place_px / size_px - 1.0, 0.0, 1.0);
    rate_here = rate;
}
