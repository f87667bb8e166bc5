#version 330 core
// A tile's light and cover in the linear image; after tile.glsl.

uniform float covers;

out vec4 light;

void main() {
    vec2 found = tile_light();
    light = vec4(found.xxx, covers * found.y);
}
