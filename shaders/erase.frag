#version 330 core
// Black under each sprite: faster than clearing an image that is mostly black. With LEVELS the image holds levels.

#ifdef LEVELS
out uint nothing;
#else
out float nothing;
#endif

void main() {
#ifdef LEVELS
    nothing = 0u;
#else
    nothing = 0.0;
#endif
}
