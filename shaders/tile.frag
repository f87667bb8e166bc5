#version 330 core
// Light that is linear over a tile, and covers what is behind it.

uniform float covers;

in float rate_here;

out vec4 light;

void main() {
    light = vec4(rate_here, 0.0, 0.0, covers);
}
