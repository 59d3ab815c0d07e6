// How far apart the view shows the points of a picture's neighbouring pixels.
//
//   gap_d = |uv - uv of the neighbour in direction d|,   limit = TORN max(m, 1)
//   h = min(gap_left, gap_right),  v = min(gap_above, gap_below),  each counts where it is below the limit,
//   or where both of its gaps are below SLANTED m^2; there are two only inside the image
//   stretch = max(1, max(h, v) / m),   opacity = 1 where one of both counts, else 0
//
// Parallel over images, rows and chunks of a row, as unproject.
//   TORN, SLANTED  see vestcl/constants.py
#include "common.h"

#define SMALLEST_PIXEL ((REAL)1e-6)

// Squared distance of two points; infinite where it is not a number.
inline REAL gap2(REAL u, REAL v, global const REAL* other) {
  const REAL du = other[0] - u, dv = other[1] - v, square = du * du + dv * dv;
  return square == square ? square : (REAL)INFINITY;
}

// Both squared distances to ``one`` and ``other``, the smaller one first.
inline REAL2 gaps2(REAL u, REAL v, global const REAL* one, global const REAL* other) {
  const REAL a = gap2(u, v, one), b = gap2(u, v, other);
  return (REAL2)(fmin(a, b), fmax(a, b));
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
    const REAL2 across = width > 1 ? gaps2(u, v, at + 2 * left, at + 2 * right) : (REAL2)INFINITY;
    const REAL2 down = height > 1 ? gaps2(u, v, at + 2 * above, at + 2 * below) : (REAL2)INFINITY;
    const REAL limit = (REAL)TORN * (m < 1 ? 1 : m), slanted = (REAL)SLANTED * m * m;
    const REAL2 limit2 = (REAL2)(limit * limit, slanted * slanted);
    const bool beside = across.x < limit2.x || (column > 0 && column + 1 < width && across.y < limit2.y);
    const bool on = down.x < limit2.x || (row > 0 && row + 1 < height && down.y < limit2.y);
    const REAL widest = fmax(beside ? across.x : 0, on ? down.x : 0);
    const REAL share = sqrt(widest) / (m < SMALLEST_PIXEL ? SMALLEST_PIXEL : m);
    factor[first + column] = share < 1 ? 1 : share;
    opacity[first + column] = beside | on | alone;
  }
}
