// Pixels with depth to 3D points.
//
//   p = z K^-1 (u, v, 1),  (u, v) = (column + 0.5, row + 0.5)
//
// Parallel over images, rows and chunks of a row: work-item (i, y, b) owns columns [i * chunk, (i + 1) * chunk) of
// row y of image b. The inverse of K comes from the host, where it costs nothing and is rounded once.
#include "common.h"

typedef struct { REAL x, y, z; } ray_t;

// What the rays of a row have in common: K^-1 (0, v, 1).
inline ray_t row_start(global const REAL* m, int row) {
  const REAL v = row + (REAL)0.5;
  const ray_t start = {m[1] * v + m[2], m[4] * v + m[5], m[7] * v + m[8]};
  return start;
}

kernel void unproject(
    const int height, const int width, const int chunk,
    global const REAL* restrict depth,      // [B, H, W]
    global const REAL* restrict inverse_K,  // [B, 3, 3]
    global REAL* restrict points_xyz)       // [B, H, W, 3] out
{
  const int begin = get_global_id(0) * chunk, end = min(begin + chunk, width);
  const int row = get_global_id(1), b = get_global_id(2);
  global const REAL* m = inverse_K + (size_t)b * 9;
  const size_t first = ((size_t)b * height + row) * width;
  const ray_t start = row_start(m, row);
  const REAL mx = m[0], my = m[3], mz = m[6];
  for (int column = begin; column < end; column++) {
    const REAL u = column + (REAL)0.5, z = depth[first + column];
    global REAL* to = points_xyz + (first + column) * 3;
    to[0] = z * (mx * u + start.x);
    to[1] = z * (my * u + start.y);
    to[2] = z * (mz * u + start.z);
  }
}

// dL/dz = g . K^-1 (u, v, 1)
kernel void unproject_backward(
    const int height, const int width, const int chunk,
    global const REAL* restrict inverse_K,        // [B, 3, 3]
    global const REAL* restrict grad_points_xyz,  // [B, H, W, 3]
    global REAL* restrict grad_depth)             // [B, H, W] out
{
  const int begin = get_global_id(0) * chunk, end = min(begin + chunk, width);
  const int row = get_global_id(1), b = get_global_id(2);
  global const REAL* m = inverse_K + (size_t)b * 9;
  const size_t first = ((size_t)b * height + row) * width;
  const ray_t start = row_start(m, row);
  const REAL mx = m[0], my = m[3], mz = m[6];
  for (int column = begin; column < end; column++) {
    const REAL u = column + (REAL)0.5;
    global const REAL* g = grad_points_xyz + (first + column) * 3;
    grad_depth[first + column] = g[0] * (mx * u + start.x) + g[1] * (my * u + start.y) + g[2] * (mz * u + start.z);
  }
}
