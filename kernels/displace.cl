// Forward 3D displacement and projection into a camera.
//
//   (a, b, c, z) = M ((x - o) + u, 1),  uv = (a / c, b / c)
//
// with M [4, 4] from the host: rows 0 to 2 are K [R|R o + t] of the target camera, row 3 is the z-row of [R|R o + t]. o
// is where that camera is in the source frame, so that nothing cancels, however far from the origin both are.
// Parallel over images and chunks of points: work-item (i, b) owns points [i * chunk, (i + 1) * chunk) of image b.
#include "common.h"

typedef struct { REAL a, b, c, z; } view_t;

inline view_t viewed(global const REAL* m, global const REAL* point, global const REAL* displacement) {
  const REAL x = point[0] - m[16] + displacement[0];
  const REAL y = point[1] - m[17] + displacement[1];
  const REAL z = point[2] - m[18] + displacement[2];
  const view_t view = {
      m[0] * x + m[1] * y + m[2] * z + m[3],
      m[4] * x + m[5] * y + m[6] * z + m[7],
      m[8] * x + m[9] * y + m[10] * z + m[11],
      m[12] * x + m[13] * y + m[14] * z + m[15]};
  return view;
}

kernel void displace(
    const int count, const int chunk,
    global const REAL* restrict points_xyz,        // [B, N, 3]
    global const REAL* restrict displacement_xyz,  // [B, N, 3]
    global const REAL* restrict projection,        // [B, 5, 4]: M, then o and 0
    global REAL* restrict points_uv,               // [B, N, 2] out
    global REAL* restrict z)                       // [B, N] out
{
  const int begin = get_global_id(0) * chunk, end = min(begin + chunk, count), b = get_global_id(1);
  global const REAL* m = projection + (size_t)b * 20;
  for (int i = begin; i < end; i++) {
    const size_t at = (size_t)b * count + i;
    const view_t view = viewed(m, points_xyz + at * 3, displacement_xyz + at * 3);
    points_uv[at * 2] = view.a / view.c;
    points_uv[at * 2 + 1] = view.b / view.c;
    z[at] = view.z;
  }
}

// dL/dx = dL/du = M^T h without its last row, with
//   h = dL/d(a, b, c, z) = (g_u / c, g_v / c, -(g_u u + g_v v) / c, g_z)
// Where uv is not finite it has no gradient: h = (0, 0, 0, g_z).
kernel void displace_backward(
    const int count, const int chunk,
    global const REAL* restrict points_xyz,        // [B, N, 3]
    global const REAL* restrict displacement_xyz,  // [B, N, 3]
    global const REAL* restrict projection,        // [B, 5, 4]: M, then o and 0
    global const REAL* restrict grad_points_uv,    // [B, N, 2]
    global const REAL* restrict grad_z,            // [B, N]
    global REAL* restrict grad_xyz)                // [B, N, 3] out
{
  const int begin = get_global_id(0) * chunk, end = min(begin + chunk, count), b = get_global_id(1);
  global const REAL* m = projection + (size_t)b * 20;
  for (int i = begin; i < end; i++) {
    const size_t at = (size_t)b * count + i;
    const view_t view = viewed(m, points_xyz + at * 3, displacement_xyz + at * 3);
    const REAL u = view.a / view.c, v = view.b / view.c;
    const bool finite = u * 0 + v * 0 == 0;
    const REAL ha = finite ? grad_points_uv[at * 2] / view.c : 0;
    const REAL hb = finite ? grad_points_uv[at * 2 + 1] / view.c : 0;
    const REAL hc = finite ? -(ha * u + hb * v) : 0;
    const REAL hz = grad_z[at];
    grad_xyz[at * 3] = m[0] * ha + m[4] * hb + m[8] * hc + m[12] * hz;
    grad_xyz[at * 3 + 1] = m[1] * ha + m[5] * hb + m[9] * hc + m[13] * hz;
    grad_xyz[at * 3 + 2] = m[2] * ha + m[6] * hb + m[10] * hc + m[14] * hz;
  }
}
