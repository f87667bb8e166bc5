#version 330 core
// A body's disc, spread by the bench's Gaussian; after rays.glsl. Axes of the sphere as in sky/bodies/disc.py.
//
// Away from limb and air brightness is smooth: a ray, or four. About them what lies at each depth inside the limb is spread
// across it. The nodes of the lit face do not depend on the pixel, so that all pixels together have all its light.
// llvmpipe runs both sides of an `if`, but leaves a loop when no pixel needs it: so what is dear is in loops, whose ends depend
// on the pixel.

#define NODES 16
#define UNIFORM 0
#define LAMBERT 1
#define LUNAR 2
#define LIMB_DARKENED 3

uniform mat3 to_sphere;           // from image axes
uniform float distance_radii;
uniform vec3 sun;
uniform float normal_e_per_s_sr;
uniform int law;
uniform float lunar_share;
uniform vec3 solar_limb;
uniform float air_radii;          // the scale height; 0 without air
uniform float slant_depth;
uniform float air_top;            // scale heights
uniform vec2 variance_px;         // of the Gaussian and of the square pixel
uniform float times;
uniform float covers;             // 0 or 1
uniform vec3 turn_rad_s;          // of the camera, image axes, while pixels light up in turn
uniform vec2 late_s_per_px;
uniform vec2 middle_px;
uniform float node[NODES];        // Gauss-Legendre on 0 to 1
uniform float weight[NODES];

out vec4 light;

const float REACH = 4.0;          // sigmas: 3e-5 of a spread edge is beyond
const float SMOOTH_PX = 200.0;    // of a radius: from here one ray is within 4e-5 of the spread light
const float SQRT3 = 1.73205081;
const float STEEP_SIGMAS = 1.5;   // of the air's scale height: three nodes are within 1 % of its spread light
const float EIGHTHS[8] = float[](-1.534, -0.887, -0.489, -0.157, 0.157, 0.489, 0.887, 1.534);  // of a Gaussian, their middles

// Towards a pixel: the share of the face's radius at which its ray passes the centre, and on which side.
struct Sight {
    float impact;
    vec2 side;
    float stretch;                // of a unit ray in the sphere's axes
};

Sight sight(vec3 seen) {
    vec3 s = to_sphere * seen;
    float across = dot(s.xy, s.xy), size = inversesqrt(dot(s, s)), side = inversesqrt(max(across, 1e-30));
    return Sight(distance_radii * across * side * size, s.xy * side, inversesqrt(dot(seen, seen)) / size);
}

// The law where a ray meets the face, `depth` radii inside the limb.
float shaded(Sight s, float depth) {
    float impact = 1.0 - depth, sine = impact / distance_radii, cosine = sqrt(max(0.0, 1.0 - sine * sine));
    float root = sqrt(max(0.0, depth * (1.0 + impact)));
    vec3 place = impact * vec3(s.side * cosine, -sine) - root * vec3(s.side * sine, cosine);
    float size = length(place * to_sphere);
    float mu0 = max(0.0, dot(place, sun) / size), mu = root * s.stretch / size;
    if (law == LAMBERT) return mu0;
    if (law == LUNAR) return mu0 > 0.0 ? lunar_share * 2.0 * mu0 / (mu0 + mu) + (1.0 - lunar_share) * mu0 : 0.0;
    if (law == LIMB_DARKENED) return solar_limb.x + mu * (solar_limb.y + mu * solar_limb.z);
    return 1.0;
}

// The air's light and depth along a ray that passes `height` radii above the limb: the light of ground that it just touches.
vec2 air(Sight s, float height) {
    float sine = 1.0 / distance_radii;
    vec3 up = vec3(s.side * sqrt(1.0 - sine * sine), -sine);
    float mu0 = max(0.0, dot(up, sun) / length(up * to_sphere));
    float covered = 1.0 - exp(-slant_depth * exp(-height / air_radii));
    return vec2(mu0 * covered / (1.0 - exp(-slant_depth)), covered);
}

// From which depth to which the face is lit on this side, radii, within `most`.
vec2 lit(Sight s, float most) {
    vec2 depths = vec2(0.0, most);
    if (law == UNIFORM || law == LIMB_DARKENED) return depths;
    float p = dot(s.side, sun.xy);
    if (sun.z >= 0.0 && p <= 0.0) return vec2(0.0);
    if (sun.z < 0.0 && p >= 0.0) return depths;
    float far = length(vec2(p, sun.z)), sine = abs(sun.z) / far, cosine = abs(p) / far;  // of the terminator from the middle
    if (distance_radii * cosine <= 1.0) return sun.z >= 0.0 ? vec2(0.0) : depths;
    float way = distance_radii - cosine;
    float depth = clamp(1.0 - distance_radii * sine / length(vec2(sine, way)), 0.0, most);
    return sun.z >= 0.0 ? vec2(0.0, depth) : vec2(depth, most);
}

float erf_of(float value) {      // Abramowitz and Stegun 7.1.26: 1.5e-7
    float t = 1.0 / (1.0 + 0.3275911 * abs(value));
    float p = t * (0.254829592 + t * (-0.284496736 + t * (1.421413741 + t * (-1.453152027 + t * 1.061405429))));
    return sign(value) * (1.0 - p * exp(-value * value));
}

float gauss(float x) {
    return 0.398942280 * exp(-0.5 * x * x);
}

// Light and cover about the limb, `depth_px` inside it (negative: outside), by light that is `fall` radii deeper a pixel.
vec2 at_edge(Sight s, float depth_px, float fall, float sigma) {
    float most = min(2.0 * REACH * sigma * fall, 1.0);
    vec2 depths = lit(s, most), found = vec2(0.0);
    float span = depths.y - depths.x;
    int nodes = depth_px > -REACH * sigma && span > 0.0 ? NODES : 0;
    for (int k = 0; k < nodes; k++) {
        float depth = depths.x + span * node[k] * node[k];
        float share = gauss((depth_px - depth / fall) / sigma) / (sigma * fall) * 2.0 * node[k] * span * weight[k];
        // A ring's light is spread to a larger ring outside and a smaller one inside.
        found.x += shaded(s, depth) * share * sqrt((1.0 - depth) / max(s.impact, 0.1));
    }
    found.y = 0.5 + 0.5 * erf_of(depth_px / (sigma * 1.41421356));
    bool steep = air_radii <= STEEP_SIGMAS * sigma * fall || depth_px >= -REACH * sigma;
    float low = max(-air_top * air_radii / fall, depth_px - REACH * sigma), high = min(0.0, depth_px + REACH * sigma);
    nodes = air_radii == 0.0 ? 0 : !steep ? 3 : high > low ? NODES : 0;
    for (int k = 0; k < nodes; k++) {
        float depth = steep ? low + (high - low) * node[k] : depth_px + SQRT3 * sigma * float(k - 1);
        float share = gauss((depth_px - depth) / sigma) / sigma * (high - low) * weight[k];
        found += air(s, -depth * fall) * (steep ? share : k == 1 ? 2.0 / 3.0 : 1.0 / 6.0);
    }
    return found;
}

// Whether the limb goes from light to dark along itself: what the Gaussian spreads along it then counts.
bool near_cusp(Sight s, float fall, float sigma) {
    if (law == UNIFORM || law == LIMB_DARKENED) return false;
    float rim = 1.0 / sqrt(distance_radii * distance_radii - 1.0);  // the tangent of the limb's angle from the middle
    return abs(dot(s.side, sun.xy) - rim * sun.z) < 2.0 * sigma * fall * length(sun.xy);
}

// With INSIDE all pixels are on a smooth and large face.
void main() {
    light = vec4(0.0);
    vec2 px = vec2(ivec2(gl_FragCoord.xy));
    vec3 seen = ray(px);
    vec3 turning = cross(turn_rad_s, seen);
    seen += dot(late_s_per_px, px - middle_px) * turning;
    mat2 slopes = ray_slopes(px);
    float sr = (slopes[0][0] * slopes[1][1] - slopes[0][1] * slopes[1][0]) / pow(dot(seen, seen), 1.5);
    Sight here = sight(seen);
#ifdef INSIDE
    light = vec4(vec3(times * normal_e_per_s_sr * sr * shaded(here, 1.0 - here.impact)), covers);
#else
    vec3 s = to_sphere * seen;
    if (s.z <= 0.0) return;
    // How the impact grows along x and y.
    float size = length(s), sine = length(s.xy) / size;
    vec3 along_x = to_sphere * (vec3(slopes[0], 0.0) + late_s_per_px.x * turning);
    vec3 along_y = to_sphere * (vec3(slopes[1], 0.0) + late_s_per_px.y * turning);
    vec2 growth = distance_radii / size * (vec2(dot(here.side, along_x.xy), dot(here.side, along_y.xy))
        - sine / size * vec2(dot(s, along_x), dot(s, along_y)));
    float fall = length(growth);
    vec2 outward = growth / fall;
    float sigma = sqrt(dot(outward * outward, variance_px));
    float depth_px = (1.0 - here.impact) / fall;
    vec2 found = vec2(0.0);
    bool inside = depth_px > REACH * sigma;
    if (depth_px < -REACH * sigma - air_top * air_radii / fall) return;
    int parts = inside ? 0 : near_cusp(here, fall, sigma) ? 8 : 1;
    for (int k = 0; k < parts; k++) {
        float turn = parts == 1 ? 0.0 : EIGHTHS[k] * sigma * fall;
        Sight beside = here;
        beside.side = mat2(cos(turn), sin(turn), -sin(turn), cos(turn)) * here.side;
        found += at_edge(beside, depth_px, fall, sigma) / float(parts);
    }
    found.y = inside ? 1.0 : found.y;
    int rays = !inside ? 0 : fall * SMOOTH_PX < 1.0 ? 1 : 4;
    vec2 off = rays == 4 ? sqrt(variance_px) : vec2(0.0);
    for (int k = 0; k < rays; k++) {
        Sight there = sight(seen + vec3(slopes * (off * vec2((k & 1) * 2 - 1, (k & 2) - 1)), 0.0));
        found.x += shaded(there, 1.0 - there.impact) / float(rays);
    }
    light = vec4(vec3(times * normal_e_per_s_sr * sr * found.x), covers * clamp(found.y, 0.0, 1.0));
#endif
}
