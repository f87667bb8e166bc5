#version 330 core
// A tile of the image, in pixels' edges; `given` is light and cover at its corner, for tiles in which they are linear.

uniform vec2 size_px;

in vec2 place_px;
in vec2 given;

out vec2 here;

void main() {
    gl_Position = vec4(2.0 * place_px / size_px - 1.0, 0.0, 1.0);
    here = given;
}
