// Why count_tiles of splat_bin.cl left points out: not part of splatting, run when somebody asks.
#include "common.h"
#include "splat.h"

// Why a point is in no list, in the order of the counts.
enum { NOT_FINITE, BEHIND, NO_RADIUS, OUTSIDE, TRANSPARENT, REASONS };

// One work-item a chunk of points.
kernel void count_skipped(
    const int height, const int width, const int points,
    global const REAL* restrict points_uv,     // [P, 2]
    global const REAL* restrict z,             // [P]
    global const REAL* restrict radii,         // [P]
    global const REAL* restrict opacities,     // [P]
    global const int* restrict intersections,  // [P]
    global int* restrict skipped)              // [chunks, REASONS] out
{
  const int c = get_global_id(0), chunks = get_global_size(0);
  const int begin = (long)points * c / chunks, end = (long)points * (c + 1) / chunks;
  int counts[REASONS];
  for (int reason = 0; reason < REASONS; reason++) counts[reason] = 0;
  for (int i = begin; i < end; i++) {
    if (intersections[i] >= 0) continue;
    const REAL u = points_uv[2 * (size_t)i], v = points_uv[2 * (size_t)i + 1], r = radii[i], o = opacities[i];
    if (u * 0 + v * 0 + z[i] * 0 + r * 0 + o * 0 != 0) counts[NOT_FINITE]++;
    else if (z[i] < (REAL)NEAR) counts[BEHIND]++;
    else if (!drawable(u, v, z[i], r, o)) counts[NO_RADIUS]++;
    else if (is_empty(footprint(u, v, r, height, width))) counts[OUTSIDE]++;
    else counts[TRANSPARENT]++;
  }
  for (int reason = 0; reason < REASONS; reason++) skipped[c * REASONS + reason] = counts[reason];
}
