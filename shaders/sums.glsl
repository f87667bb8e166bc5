// The light of pixels, row by row, as whole numbers of a unit: their sum is the same in whatever order stars are added.

layout(std430, binding = 7) buffer PixelSums { int sums[]; };
uniform float unit_e_per_s;
