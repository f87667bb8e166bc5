#version 330 core
// A tile of the image, in pixels' edges; `given` is what tile.glsl has at its corner.

uniform vec2 size_px;

in vec2 place_px;
in vec4 given;

out vec4 here;

void main() {
    gl_Position = vec4(2.0 * place_px / size_px - 1.0, 0.0, 1.0);
    here = given;
}
