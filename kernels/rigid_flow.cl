// How far a rigid motion of the camera moves each point.
//
//   u = R x + t - x,  R = I + 2 S(q'),  q' = (w, x, y, z) = q / max(|q|, QUATERNION_FLOOR)
//
//       | -(yy + zz)   xy - wz      xz + wy    |
//   S = | xy + wz      -(xx + zz)   yz - wx    |   so that u = 2 S x + t: the difference is never taken
//       | xz - wy      yz + wx      -(xx + yy) |
//
// Forward and the gradient of the points are parallel over images and chunks of points: work-item (i, b) owns points
// [i * chunk, (i + 1) * chunk) of image b. The gradient of the motion is a sum over all points of an image. It is
// taken in CHUNKS partial sums per image, a work-item each, which one work-item per image then adds up in order; both
// sums carry their rounding error along (Kahan), so float32 keeps its precision over any number of points.
// A point that is not finite gets NaN, and takes no part in any gradient.
#include "common.h"
#ifndef CHUNKS
#error "define CHUNKS, the number of partial sums per image"
#endif
#ifndef QUATERNION_FLOOR
#error "define QUATERNION_FLOOR, the least length that a quaternion is divided by"
#endif

typedef struct { REAL xx, xy, xz, yx, yy, yz, zx, zy, zz; } matrix_t;

// q / max(|q|, QUATERNION_FLOOR) as (w, x, y, z) in .s0123
inline REAL4 normalised(REAL4 q) {
  return q / max(length(q), (REAL)QUATERNION_FLOOR);
}

// 2 S(q') = R - I
inline matrix_t rotation_less_identity(REAL4 q) {
  const REAL w = q.s0, x = q.s1, y = q.s2, z = q.s3;
  const matrix_t m = {
      -2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
      2 * (x * y + w * z), -2 * (x * x + z * z), 2 * (y * z - w * x),
      2 * (x * z - w * y), 2 * (y * z + w * x), -2 * (x * x + y * y)};
  return m;
}

// 0 if all three are finite, else NaN
inline REAL finite_or_nan(REAL x, REAL y, REAL z) {
  return x * 0 + y * 0 + z * 0;
}

kernel void rigid_flow(
    const int count, const int chunk,
    global const REAL* restrict points_xyz,   // [B, N, 3]
    global const REAL* restrict quaternion,   // [B, 4]
    global const REAL* restrict translation,  // [B, 3]
    global REAL* restrict displacement_xyz)   // [B, N, 3] out
{
  const int begin = get_global_id(0) * chunk, end = min(begin + chunk, count), b = get_global_id(1);
  const matrix_t m = rotation_less_identity(normalised(vload4(b, quaternion)));
  const REAL tx = translation[b * 3], ty = translation[b * 3 + 1], tz = translation[b * 3 + 2];
  for (int i = begin; i < end; i++) {
    const size_t at = ((size_t)b * count + i) * 3;
    const REAL x = points_xyz[at], y = points_xyz[at + 1], z = points_xyz[at + 2];
    const REAL poison = finite_or_nan(x, y, z);
    displacement_xyz[at] = m.xx * x + m.xy * y + m.xz * z + tx + poison;
    displacement_xyz[at + 1] = m.yx * x + m.yy * y + m.yz * z + ty + poison;
    displacement_xyz[at + 2] = m.zx * x + m.zy * y + m.zz * z + tz + poison;
  }
}

// dL/dx = (R - I)^T g
kernel void rigid_flow_backward_points(
    const int count, const int chunk,
    global const REAL* restrict points_xyz,             // [B, N, 3]
    global const REAL* restrict quaternion,             // [B, 4]
    global const REAL* restrict grad_displacement_xyz,  // [B, N, 3]
    global REAL* restrict grad_points_xyz)              // [B, N, 3] out
{
  const int begin = get_global_id(0) * chunk, end = min(begin + chunk, count), b = get_global_id(1);
  const matrix_t m = rotation_less_identity(normalised(vload4(b, quaternion)));
  for (int i = begin; i < end; i++) {
    const size_t at = ((size_t)b * count + i) * 3;
    const bool finite = finite_or_nan(points_xyz[at], points_xyz[at + 1], points_xyz[at + 2]) == 0;
    const REAL gx = grad_displacement_xyz[at], gy = grad_displacement_xyz[at + 1], gz = grad_displacement_xyz[at + 2];
    grad_points_xyz[at] = finite ? m.xx * gx + m.yx * gy + m.zx * gz : 0;
    grad_points_xyz[at + 1] = finite ? m.xy * gx + m.yy * gy + m.zy * gz : 0;
    grad_points_xyz[at + 2] = finite ? m.xz * gx + m.yz * gy + m.zz * gz : 0;
  }
}

// A sum and the rounding error that it still owes.
typedef struct { REAL4 sum, owed; } kahan_t;

inline kahan_t added(kahan_t a, REAL4 term) {
  const REAL4 exact = term - a.owed;
  const REAL4 sum = a.sum + exact;
  const kahan_t result = {sum, (sum - a.sum) - exact};
  return result;
}

// Partial sums of g_i (x, y, z, 1), i = 0, 1, 2: the gradients of row i of R and of t_i.
kernel void rigid_flow_backward_sums(
    const int count,
    global const REAL* restrict points_xyz,             // [B, N, 3]
    global const REAL* restrict grad_displacement_xyz,  // [B, N, 3]
    global REAL* restrict partial_sums)                 // [B, CHUNKS, 3, 4] out
{
  const int i = get_global_id(0), b = get_global_id(1);
  if (i >= CHUNKS) return;
  const int begin = (int)((long)count * i / CHUNKS), end = (int)((long)count * (i + 1) / CHUNKS);
  kahan_t x_sums = {0, 0}, y_sums = {0, 0}, z_sums = {0, 0};
  for (int n = begin; n < end; n++) {
    const size_t at = (size_t)b * count + n;
    const REAL x = points_xyz[at * 3], y = points_xyz[at * 3 + 1], z = points_xyz[at * 3 + 2];
    if (finite_or_nan(x, y, z) != 0) continue;
    const REAL4 point = (REAL4)(x, y, z, 1);
    x_sums = added(x_sums, grad_displacement_xyz[at * 3] * point);
    y_sums = added(y_sums, grad_displacement_xyz[at * 3 + 1] * point);
    z_sums = added(z_sums, grad_displacement_xyz[at * 3 + 2] * point);
  }
  const size_t to = ((size_t)b * CHUNKS + i) * 3;
  vstore4(x_sums.sum, to, partial_sums);
  vstore4(y_sums.sum, to + 1, partial_sums);
  vstore4(z_sums.sum, to + 2, partial_sums);
}

// dL/dq' from dL/dR = G (row i of G in .xyz of row i), by the entries of S.
inline REAL4 grad_normalised(REAL4 q, REAL4 gx, REAL4 gy, REAL4 gz) {
  const REAL w = q.s0, x = q.s1, y = q.s2, z = q.s3;
  return 2 * (REAL4)(
      x * (gz.y - gy.z) + y * (gx.z - gz.x) + z * (gy.x - gx.y),
      w * (gz.y - gy.z) + y * (gx.y + gy.x) + z * (gx.z + gz.x) - 2 * x * (gy.y + gz.z),
      w * (gx.z - gz.x) + x * (gx.y + gy.x) + z * (gy.z + gz.y) - 2 * y * (gx.x + gz.z),
      w * (gy.x - gx.y) + x * (gx.z + gz.x) + y * (gy.z + gz.y) - 2 * z * (gx.x + gy.y));
}

// dL/dt = sum g;  dL/dq = (g' - q' (q' . g')) / |q| with g' = dL/dq', and g' / QUATERNION_FLOOR below the floor, where
// q' is linear in q.
kernel void rigid_flow_backward_motion(
    const int batch,
    global const REAL* restrict quaternion,    // [B, 4]
    global const REAL* restrict partial_sums,  // [B, CHUNKS, 3, 4]
    global REAL* restrict grad_quaternion,     // [B, 4] out
    global REAL* restrict grad_translation)    // [B, 3] out
{
  const int b = get_global_id(0);
  if (b >= batch) return;
  kahan_t x_sums = {0, 0}, y_sums = {0, 0}, z_sums = {0, 0};
  for (int i = 0; i < CHUNKS; i++) {
    const size_t at = ((size_t)b * CHUNKS + i) * 3;
    x_sums = added(x_sums, vload4(at, partial_sums));
    y_sums = added(y_sums, vload4(at + 1, partial_sums));
    z_sums = added(z_sums, vload4(at + 2, partial_sums));
  }
  grad_translation[b * 3] = x_sums.sum.w;
  grad_translation[b * 3 + 1] = y_sums.sum.w;
  grad_translation[b * 3 + 2] = z_sums.sum.w;

  const REAL4 q = vload4(b, quaternion), unit = normalised(q);
  const REAL norm = length(q);
  const REAL4 g = grad_normalised(unit, x_sums.sum, y_sums.sum, z_sums.sum);
  const REAL4 across = norm >= (REAL)QUATERNION_FLOOR ? g - unit * dot(unit, g) : g;
  vstore4(across / max(norm, (REAL)QUATERNION_FLOOR), b, grad_quaternion);
}
