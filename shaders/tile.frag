#version 330 core
// Light and cover that are linear over a tile.

uniform float covers;

in vec2 here;

out vec4 light;

void main() {
    light = vec4(here.xxx, covers * here.y);
}
