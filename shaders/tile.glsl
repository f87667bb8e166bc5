// Light and cover of a pixel in a tile: linear over a face; with AIR those of a ray, which is linear in the axes of the sphere.
// Two programs, for even a loop that does nothing costs llvmpipe more than a face.
#ifdef AIR
// Distance of the body and scale height of its air, radii; optical depth of a ray that touches the limb; half of the Gaussian's
// variance in scale heights, by which it adds so many second derivatives.
uniform vec4 air;
#endif

in vec4 here;  // light and cover; in air light of a ray that is stopped, and the ray

vec2 tile_light() {
#ifdef AIR
    float across = dot(here.yz, here.yz);
    float height = (air.x * sqrt(across / (across + here.w * here.w)) - 1.0) / air.y;
    float depth = air.z * exp(-height);
    float stopped = depth < 0.02 ? depth * (1.0 - depth * (0.5 - depth / 6.0)) : 1.0 - exp(-depth);
    stopped += air.w * depth * (1.0 - depth) * (1.0 - stopped);
    return vec2(here.x * stopped, stopped);
#else
    return here.xy;
#endif
}
