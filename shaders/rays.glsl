// Each pixel's direction (u, v, 1) in image axes: a pinhole's, and with LENS a shift between nodes of a grid.
// Linear by hand: a GL's own filter has weights of eight bits.
// `ray_slopes` is how (u, v) grow along x, its first column, and along y.

uniform vec2 principal_px;
uniform float focal_px;
#ifdef LENS
uniform sampler2D shifts;     // of tangents, nodes from edge to edge of the image
uniform vec2 nodes_per_px;
#endif

vec3 ray(vec2 px) {
    vec2 tangents = (px - principal_px) / focal_px;
#ifdef LENS
    vec2 at = (px + 0.5) * nodes_per_px;
    ivec2 node = clamp(ivec2(floor(at)), ivec2(0), textureSize(shifts, 0) - 2);
    vec2 part = at - vec2(node);
    vec2 top = mix(texelFetch(shifts, node, 0).rg, texelFetch(shifts, node + ivec2(1, 0), 0).rg, part.x);
    vec2 bottom = mix(texelFetch(shifts, node + ivec2(0, 1), 0).rg, texelFetch(shifts, node + ivec2(1, 1), 0).rg, part.x);
    tangents += mix(top, bottom, part.y);
#endif
    return vec3(tangents, 1.0);
}

mat2 ray_slopes(vec2 px) {
    mat2 slopes = mat2(1.0 / focal_px);
#ifdef LENS
    vec2 at = (px + 0.5) * nodes_per_px;
    ivec2 node_at = clamp(ivec2(floor(at)), ivec2(0), textureSize(shifts, 0) - 2);
    vec2 part = at - vec2(node_at);
    vec2 a = texelFetch(shifts, node_at, 0).rg, b = texelFetch(shifts, node_at + ivec2(1, 0), 0).rg;
    vec2 c = texelFetch(shifts, node_at + ivec2(0, 1), 0).rg, d = texelFetch(shifts, node_at + ivec2(1, 1), 0).rg;
    slopes[0] += mix(b - a, d - c, part.y) * nodes_per_px.x;
    slopes[1] += mix(c - a, d - b, part.x) * nodes_per_px.y;
#endif
    return slopes;
}
