#version 330 core
// Black under a sprite: cheaper than clearing an image of which little was drawn on. With LEVELS the image is one of levels.

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
