// Primaries that are driven apart (APART) are planes of one image; else there is one plane. With OFFSETS a pixel's
// light of plane k lies at places_px[k] from its middle.
#ifdef IMAGES  // of encode.frag: this text comes first
#extension GL_ARB_shader_image_load_store : require
#endif
#ifdef APART
#define PLANES 3
#define WORDS 8
#else
#define PLANES 1
#define WORDS 5
#endif
#ifdef OFFSETS
uniform vec2 places_px[PLANES];
#define OFF(k) + places_px[k]
#else
#define OFF(k)
#endif
