// Compositing, one work-group per tile and one work-item per pixel: the mapping for GPUs. The formulas are those of
// splat_composite.cl.
//
// Forward: the group stages GROUP points of the tile's list at a time in local memory, and each work-item composites
// those that reach its pixel. It goes on to the next points only if a pixel of the tile can still change. Backward, three steps, none of which adds to what another work-item writes:
//   1. each pixel traverses its fragments forward and backward and writes w_i and dL/da_i to scratch at (entry, pixel),
//   2. each entry sums over its pixels; entries of a point in several tiles run in several launches, as in
//      splat_composite.cl, so that only one at a time adds to the point's gradients,
//   3. each tile sums its pixels' share of the background's gradient.
//
//   CHANNELS         features per point
//   CHANNEL_GROUP    channels that one work-item of the forward keeps in registers: at most CHANNELS. Where it does not
//                    divide CHANNELS, the last group overlaps the one before, so that every loop has that many turns:
//                    an array that is indexed in any other loop would be in memory.
#include "common.h"
#include "splat.h"
#ifndef CHANNELS
#error "define CHANNELS, the number of features per point"
#endif
#ifndef CHANNEL_GROUP
#error "define CHANNEL_GROUP, the channels that a work-item composites"
#endif
#ifndef TRUNCATE
#error "define TRUNCATE as 0 or 1"
#endif
#if CHANNEL_GROUP < 1 || CHANNEL_GROUP > CHANNELS
#error "CHANNEL_GROUP must be at least 1 and at most CHANNELS"
#endif

inline void clear_row(global REAL* row) {
  for (int c = 0; c < CHANNELS; c++) row[c] = 0;
}

#include "splat_gradients.h"
#define GROUP (TILE * TILE)

#if TRUNCATE
#define EXISTS(d2, r2, t) ((d2) < (r2) && (t) >= min_transmittance)
#else
#define EXISTS(d2, r2, t) ((d2) < (r2))
#endif

// One work-item per point: whether all its features are finite.
kernel void find_finite(const int points, global const REAL* restrict features, global int* restrict finite) {
  const int i = get_global_id(0);
  if (i >= points) return;
  REAL zero = 0;
  for (int c = 0; c < CHANNELS; c++) zero += features[(size_t)i * CHANNELS + c] * 0;
  finite[i] = zero == 0;
}

// The group copies entries [e, e + GROUP) of its list; those that make no fragment get r = 0.
inline void stage(
    local record_t* staged, int lane, int e, int end, global const record_t* records, global const int* finite) {
  if (e + lane < end) {
    record_t record = records[e + lane];
    if (!finite[record.id]) record.r = 0;
    staged[lane] = record;
  }
}

kernel __attribute__((reqd_work_group_size(GROUP, 1, 1))) void composite_pixels(
    const int height, const int width, const int tiles_y, const int tiles_x, const REAL min_transmittance,
    global const int* restrict tile_starts,   // [B * tiles + 1]
    global const record_t* restrict records,  // [E]
    global const int* restrict finite,        // [P]
    global const REAL* restrict features,     // [P, C]
    global const REAL* restrict backgrounds,  // [B, C]
    global REAL* restrict image,              // [B, H, W, C] out
    global REAL* restrict coverage)           // [B, H, W] out
{
  local record_t staged[GROUP];
  local int last_open;  // the last e after whose points a pixel of the tile could still change
  const int lane = get_local_id(0), index = get_group_id(0), own = get_global_id(1) * CHANNEL_GROUP;
  const int first = smaller_of(own, CHANNELS - CHANNEL_GROUP);  // channels before `own` are another group's
  const int b = index / (tiles_y * tiles_x);
  const int x = index % tiles_x * TILE + lane % TILE, y = index / tiles_x % tiles_y * TILE + lane / TILE;
  const bool shown = x < width && y < height;
  REAL sums[CHANNEL_GROUP];
#pragma unroll
  for (int c = 0; c < CHANNEL_GROUP; c++) sums[c] = 0;
  REAL t = 1;
  const int begin = tile_starts[index], end = tile_starts[index + 1];
  if (lane == 0) last_open = -1;
  for (int e = begin; e < end; e += GROUP) {
    stage(staged, lane, e, end, records, finite);
    barrier(CLK_LOCAL_MEM_FENCE);
    const int count = smaller_of(GROUP, end - e);
    for (int i = 0; i < count; i++) {
      const REAL dx = x + (REAL)0.5 - staged[i].u, dy = y + (REAL)0.5 - staged[i].v, d2 = dx * dx + dy * dy;
      const REAL r2 = staged[i].r * staged[i].r;
      if (!EXISTS(d2, r2, t) || t == 0) continue;
      const REAL a = staged[i].o - staged[i].o / r2 * d2, w = a * t;
      global const REAL* row = features + (size_t)staged[i].id * CHANNELS + first;
#pragma unroll
      for (int c = 0; c < CHANNEL_GROUP; c++) sums[c] += w * row[c];
      t *= 1 - a;
    }
    if (shown && EXISTS(0, 1, t) && t != 0) last_open = e;  // the same number from all who write it
    barrier(CLK_LOCAL_MEM_FENCE);
    if (last_open != e) break;  // all work-items read the same: barriers do not diverge
  }
  if (shown) {
    const size_t at = ((size_t)b * height + y) * width + x;
    if (own == 0) coverage[at] = 1 - t;
#pragma unroll
    for (int c = 0; c < CHANNEL_GROUP; c++)
      if (first + c >= own) image[at * CHANNELS + first + c] = sums[c] + t * backgrounds[b * CHANNELS + first + c];
  }
}

#ifdef GRAD_FEATURES
inline int offset_in(box_t box, int x, int y) { return (y - box.y0) * (box.x1 - box.x0) + x - box.x0; }

// Step 1.
kernel __attribute__((reqd_work_group_size(GROUP, 1, 1))) void composite_pixels_backward(
    const int height, const int width, const int tiles_y, const int tiles_x, const REAL min_transmittance,
    const long image_stride, const long row_stride, const long pixel_stride, const long channel_stride,
    global const int* restrict tile_starts,     // [B * tiles + 1]
    global const record_t* restrict records,    // [E]
    global const long* restrict tile_offsets,   // [B * tiles]
    global const long* restrict entry_offsets,  // [E], from there on
    global const int* restrict finite,          // [P]
    global const REAL* restrict features,       // [P, C]
    global const REAL* restrict backgrounds,    // [B, C]
    global const REAL* restrict grad_image,     // [B, C, H, W] by strides
    global const REAL* restrict grad_coverage,  // [B, H, W]
    global REAL* restrict scratch_weights,      // [S] out: w_i
    global REAL* restrict scratch_grads,        // [S] out: dL/da_i
    global REAL* restrict transmittance)        // [B, H, W] out: T_end
{
  const int lane = get_local_id(0), index = get_group_id(0);
  const int b = index / (tiles_y * tiles_x);
  const int left = index % tiles_x * TILE, top = index / tiles_x % tiles_y * TILE;
  const int column = lane % TILE, line = lane / TILE, x = left + column, y = top + line;
  if (x >= width || y >= height) return;
  const int begin = tile_starts[index], end = tile_starts[index + 1];
  REAL t = 1;
  for (int e = begin; e < end; e++) {
    const box_t box = unpack_box(records[e].box);
    if (column < box.x0 || column >= box.x1 || line < box.y0 || line >= box.y1) continue;
    const REAL dx = x + (REAL)0.5 - records[e].u, dy = y + (REAL)0.5 - records[e].v, d2 = dx * dx + dy * dy;
    const REAL r2 = records[e].r * records[e].r;
    const bool exists = EXISTS(d2, r2, t) && finite[records[e].id];
    const REAL a = exists ? records[e].o - records[e].o / r2 * d2 : (REAL)0;
    const size_t offset = tile_offsets[index] + entry_offsets[e] + offset_in(box, column, line);
    scratch_weights[offset] = exists ? t : (REAL)0;
    scratch_grads[offset] = a;
    t *= 1 - a;
  }
  const size_t at = ((size_t)b * height + y) * width + x;
  transmittance[at] = t;
  global const REAL* g = grad_image + b * image_stride + y * row_stride + x * pixel_stride;
  REAL behind = 0;
#if HAS_GRAD_COVERAGE
  behind -= grad_coverage[at];
#endif
#if HAS_BACKGROUNDS
  for (int c = 0; c < CHANNELS; c++) behind += backgrounds[b * CHANNELS + c] * g[c * channel_stride];
#endif
  for (int e = end - 1; e >= begin; e--) {
    const box_t box = unpack_box(records[e].box);
    if (column < box.x0 || column >= box.x1 || line < box.y0 || line >= box.y1) continue;
    const size_t offset = tile_offsets[index] + entry_offsets[e] + offset_in(box, column, line);
    const REAL before = scratch_weights[offset], a = scratch_grads[offset];
    if (a == 0 && before == 0) continue;
    REAL fg = 0;
    for (int c = 0; c < CHANNELS; c++)
      fg += features[(size_t)records[e].id * CHANNELS + c] * g[c * channel_stride];
    scratch_weights[offset] = a * before;
    scratch_grads[offset] = before * (fg - behind);
    behind = a * fg + (1 - a) * behind;
  }
}

// Step 2, for the tiles (x0 + i * step_x, y0 + j * step_y): no two of them share a point.
kernel __attribute__((reqd_work_group_size(GROUP, 1, 1))) void sum_scratch(
    const int height, const int width, const int tiles_y, const int tiles_x,
    const int x0, const int y0, const int step_x, const int step_y,
    const long image_stride, const long row_stride, const long pixel_stride, const long channel_stride,
    global const int* restrict tile_starts,       // [B * tiles + 1]
    global const record_t* restrict records,      // [E]
    global const long* restrict tile_offsets,     // [B * tiles]
    global const long* restrict entry_offsets,    // [E], from there on
    global const REAL* restrict scratch_weights,  // [S]
    global const REAL* restrict scratch_grads,    // [S]
    global const REAL* restrict grad_image,       // [B, C, H, W] by strides
    global REAL* restrict grad_features,          // [P, C] out
    global REAL* restrict grad_points_uv,         // [P, 2] out
    global REAL* restrict grad_radii,             // [P] out
    global REAL* restrict grad_opacities)         // [P] out
{
  const int lane = get_local_id(0);
  const int tx = x0 + (int)get_group_id(0) * step_x, ty = y0 + (int)get_group_id(1) * step_y, b = get_group_id(2);
  const int index = (b * tiles_y + ty) * tiles_x + tx;
  const int left = tx * TILE, top = ty * TILE;
  for (int e = tile_starts[index] + lane; e < tile_starts[index + 1]; e += GROUP) {
    const record_t point = records[e];
    const box_t box = unpack_box(point.box);
    const bool first = is_first(point.box);
    const size_t start = tile_offsets[index] + entry_offsets[e];
    global const REAL* g = grad_image + b * image_stride + top * row_stride + left * pixel_stride;
#if GRAD_FEATURES
    for (int c = 0; c < CHANNELS; c++) {
      REAL sum = 0;
      for (int y = box.y0; y < box.y1; y++)
        for (int x = box.x0; x < box.x1; x++) {
          const long pixel = y * row_stride + x * pixel_stride;
          sum += scratch_weights[start + offset_in(box, x, y)] * g[pixel + c * channel_stride];
        }
      const size_t at = (size_t)point.id * CHANNELS + c;
      grad_features[at] = (first ? (REAL)0 : grad_features[at]) + sum;
    }
#endif
#if GRAD_GEOMETRY
    REAL sum_da = 0, sum_dx = 0, sum_dy = 0, sum_d2 = 0;
    for (int y = box.y0; y < box.y1; y++)
      for (int x = box.x0; x < box.x1; x++) {
        const REAL da = scratch_grads[start + offset_in(box, x, y)];
        const REAL dx = left + x + (REAL)0.5 - point.u, dy = top + y + (REAL)0.5 - point.v;
        sum_da += da;
        sum_dx += da * dx;
        sum_dy += da * dy;
        sum_d2 += da * (dx * dx + dy * dy);
      }
    const REAL r2 = point.r * point.r, slope = 2 * (point.o / r2);
    const point_grads_t grads = {slope * sum_dx, slope * sum_dy, slope * sum_d2 / point.r, sum_da - sum_d2 / r2};
    write_scalars(grads, point.id, first, grad_points_uv, grad_radii, grad_opacities);
#endif
  }
}

// Step 3, one work-item per channel of a tile.
kernel void sum_tile_backgrounds(
    const int height, const int width, const int tiles_y, const int tiles_x,
    const int tiles,  // of all images
    const long image_stride, const long row_stride, const long pixel_stride, const long channel_stride,
    global const REAL* restrict transmittance,    // [B, H, W]
    global const REAL* restrict grad_image,       // [B, C, H, W] by strides
    global REAL* restrict tile_grad_backgrounds)  // [B * tiles, C] out
{
  const int i = get_global_id(0), index = i / CHANNELS, c = i % CHANNELS;
  if (index >= tiles) return;
  const int b = index / (tiles_y * tiles_x);
  const int left = index % tiles_x * TILE, top = index / tiles_x % tiles_y * TILE;
  global const REAL* g = grad_image + b * image_stride + c * channel_stride;
  REAL sum = 0;
  for (int y = top; y < smaller_of(top + TILE, height); y++) {
    REAL row = 0;
    for (int x = left; x < smaller_of(left + TILE, width); x++)
      row += transmittance[((size_t)b * height + y) * width + x] * g[y * row_stride + x * pixel_stride];
    sum += row;
  }
  tile_grad_backgrounds[i] = sum;
}
#endif
