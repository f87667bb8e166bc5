#version 330 core
// Black under each sprite: faster than clearing an image that is mostly black. With LEVELS the image holds levels, and has that one.

#ifdef LEVELS
out uvec4 nothing;
#else
out vec4 nothing;
#endif

void main() {
#ifdef LEVELS
    nothing = uvec4(LEVELS);
#else
    nothing = vec4(0.0);
#endif
}
