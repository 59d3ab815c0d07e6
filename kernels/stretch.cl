// How far apart the view shows the points of an image's neighbouring pixels.
//
//   gap_d = |uv - uv of the neighbour in direction d|,   limit = TORN max(m, 1)
//   h = min(gap_left, gap_right),  v = min(gap_above, gap_below),  each counts where it is below the limit,
//   or where both of its gaps are below SLANTED m^2; there are two only inside the image
//   r = (uv_right - uv_left) / 2,  d = (uv_below - uv_above) / 2: where |uv_right + uv_left - 2 uv| < BENT |r|, and so
//   for d, the points are of one plane, and v = |r x d| / |r| if |r| < limit and v < max(limit, SLANTED m^2); h too
//   stretch = max(1, max(h, v) / m),   opacity = 1 where one of both counts, else 0
//
// Parallel over images, rows and chunks of a row, as unproject.
//   TORN, SLANTED, BENT  see vestcl/constants.py
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

inline REAL2 half_step(global const REAL* one, global const REAL* other) {
  return (REAL2)(other[0] - one[0], other[1] - one[1]) / 2;
}

inline bool is_flat(global const REAL* at, global const REAL* one, global const REAL* other, REAL2 step) {
  const REAL2 bend = (REAL2)(other[0] + one[0] - 2 * at[0], other[1] + one[1] - 2 * at[1]);
  return dot(bend, bend) < (REAL)BENT * (REAL)BENT * dot(step, step);
}

// Squared distances between columns and between rows of one plane; infinite where there is none.
inline REAL2 between_lines(global const REAL* at, long width, REAL limit2) {
  const REAL2 right = half_step(at - 2, at + 2), down = half_step(at - 2 * width, at + 2 * width);
  if (!is_flat(at, at - 2, at + 2, right) || !is_flat(at, at - 2 * width, at + 2 * width, down))
    return (REAL2)INFINITY;
  const REAL area = right.x * down.y - right.y * down.x, along = dot(right, right), across = dot(down, down);
  return (REAL2)(across < limit2 ? area * area / across : INFINITY, along < limit2 ? area * area / along : INFINITY);
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
  const bool single = height == 1 && width == 1;
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
    const bool in_row = across.x < limit2.x || (column > 0 && column + 1 < width && across.y < limit2.y);
    const bool on = down.x < limit2.x || (row > 0 && row + 1 < height && down.y < limit2.y);
    const bool inside = column > 0 && column + 1 < width && row > 0 && row + 1 < height;
    const REAL2 lines = inside ? between_lines(at, width, limit2.x) : (REAL2)INFINITY;
    const REAL most = fmax(limit2.x, limit2.y);
    const REAL h2 = lines.x < most ? lines.x : in_row ? across.x : 0, v2 = lines.y < most ? lines.y : on ? down.x : 0;
    const REAL widest = fmax(h2, v2);
    const REAL share = sqrt(widest) / (m < SMALLEST_PIXEL ? SMALLEST_PIXEL : m);
    factor[first + column] = share < 1 ? 1 : share;
    opacity[first + column] = in_row | on | single;
  }
}
