// How far apart the view shows the points of a picture's neighbouring pixels.
//
//   gap_d = |uv - uv of the neighbour in direction d|,   limit = TORN max(m, 1)
//   h = min(gap_left, gap_right),  v = min(gap_above, gap_below),  each counts where it is below the limit
//   stretch = max(1, max(h, v) / m),   opacity = 1 where one of both counts, else 0
//
// Parallel over images, rows and chunks of a row, as unproject.
//   TORN  see vestcl/constants.py
#include "common.h"

#define SMALLEST_PIXEL ((REAL)1e-6)

// Squared distance of two points; infinite where it is not a number.
inline REAL gap2(REAL u, REAL v, global const REAL* other) {
  const REAL du = other[0] - u, dv = other[1] - v, square = du * du + dv * dv;
  return square == square ? square : (REAL)INFINITY;
}

kernel void stretch(
    const int height, const int width, const int chunk,
    global const REAL* restrict points_uv,  // [B, H, W, 2]
    global const REAL* restrict magnified,  // [B, H, W]
    global REAL* restrict factor,           // [B, H, W] out
    global REAL* restrict opacity)          // [B, H, W] out
{
  const int begin = get_global_id(0) * chunk, end = min(begin + chunk, width);
  const int row = get_global_id(1), b = get_global_id(2);
  const size_t first = ((size_t)b * height + row) * width;
  const bool alone = height == 1 && width == 1;
  // Beyond the first and the last row, a row's neighbour is the one on its other side: the nearer one is the same.
  const long above = row > 0 ? -(long)width : width, below = row + 1 < height ? width : -(long)width;
  for (int column = begin; column < end; column++) {
    global const REAL* at = points_uv + 2 * (first + column);
    const int left = column > 0 ? -1 : 1, right = column + 1 < width ? 1 : -1;
    const REAL u = at[0], v = at[1], m = magnified[first + column];
    const REAL across = width > 1 ? fmin(gap2(u, v, at + 2 * left), gap2(u, v, at + 2 * right)) : (REAL)INFINITY;
    const REAL down = height > 1 ? fmin(gap2(u, v, at + 2 * above), gap2(u, v, at + 2 * below)) : (REAL)INFINITY;
    const REAL limit = (REAL)TORN * (m < 1 ? 1 : m), limit2 = limit * limit;
    const REAL widest = fmax(across < limit2 ? across : 0, down < limit2 ? down : 0);
    const REAL share = sqrt(widest) / (m < SMALLEST_PIXEL ? SMALLEST_PIXEL : m);
    factor[first + column] = share < 1 ? 1 : share;
    opacity[first + column] = (across < limit2) | (down < limit2) | alone;
  }
}
