// Compositing, one work-item per tile: the mapping for CPUs.
//
// A pixel's fragments, front to back in the order (z, index), have a_i = o_i (1 - d2_i / r_i^2) and
//   T_0 = 1,  w_i = a_i T_i,  T_(i+1) = T_i (1 - a_i),  image = sum_i w_i f_i + T_end b,  coverage = 1 - T_end.
// The tile's list is in that order for every pixel, so the work-item traverses it once, point by point, and adds into
// the tile's pixels, which stay in the cache. The point's row of features is read once per tile, a few points
// ahead: the list is in depth order and the rows are anywhere.
//
// Backward (splat_tile_backward.h), with g = dL/dimage and h = dL/dcoverage at a pixel, and no division by 1 - a:
//   A_end = b.g - h,  A_i = a_i (f_i.g) + (1 - a_i) A_(i+1),  dL/da_i = T_i (f_i.g - A_(i+1)),
//   dL/df_i = w_i g,  dL/db = sum over pixels of T_end g,
//   da/du = 2 o dx / r^2,  da/dr = 2 o d2 / r^3,  da/do = 1 - d2 / r^2,  where dx = x + 0.5 - u.
// T_i needs a forward traversal, A_i a backward one. The forward one keeps a_i and T_i of SEGMENT fragments; a longer
// list is cut into segments, whose first T are kept (a checkpoint); each is traversed forward again, then backward.
//
//   ONE_ITEM   defined: composite_few_backward, one work-item for all tiles, is there too
#include "common.h"
#include "splat.h"
#include "prefetch.h"
#include "channels.h"
#include "splat_gradients.h"
#include "tile.h"
#include "splat_traversal.h"
#include "splat_tile_backward.h"

// Entries between two looks whether every pixel of the tile is opaque.
#define LOOK_EVERY 256

kernel void composite_tiles(
    const int height, const int width, const int tiles_y, const int tiles_x, const REAL min_transmittance,
    global const int* restrict tile_starts,   // [B * tiles + 1]
    global const record_t* restrict records,  // [E]
    global const REAL* restrict features,     // [P, C]
    global const REAL* restrict backgrounds,  // [B, C]
    global REAL* restrict image,              // [B, H, W, C] out
    global REAL* restrict coverage,           // [B, H, W] out
    global int* restrict tile_traversed)      // [B * tiles] out: see pack_traversed
{
  const int index = get_global_id(0);
  const tile_t tile = tile_at(index, height, width, tiles_y, tiles_x);
  vector_t sums[PADDED][BLOCKS];
  REAL transmittance[PADDED];
  for (int p = 0; p < PADDED; p++) {
    transmittance[p] = 1;
#pragma unroll
    for (int k = 0; k < BLOCKS; k++) sums[p][k] = 0;
  }

  const int begin = tile_starts[index], last = tile_starts[get_global_size(0)] - 1;
  int end = tile_starts[index + 1];
  bool finite = true;
  for (int e = begin; e < end; e++) {
    read_ahead(records, smaller_of(e + AHEAD, last), features);  // across the end, into the list of the next tile
    global const record_t* point = records + e;
    vector_t f[BLOCKS];
    if (!load_row(features + (size_t)point->id * CHANNELS, f)) {
      finite = false;
      continue;
    }
    const disc_t disc = disc_of(point, tile);
    const box_t box = unpack_box(point->box);
    for (int y = box.y0; y < box.y1; y += 2)
      for (int x = box.x0; x < box.x1; x += 2) {
        const int p = y * STRIDE + x;
        REAL4 before;
        const REAL4 t = load_quad(transmittance, p);
        const REAL4 a = quad_alphas(disc, x, y, t, min_transmittance, &before), w = a * t;
        store_quad(t * (1 - a), transmittance, p);
#pragma unroll
        for (int k = 0; k < BLOCKS; k++) {
          sums[p][k] += w.x * f[k];
          sums[p + 1][k] += w.y * f[k];
          sums[p + STRIDE][k] += w.z * f[k];
          sums[p + STRIDE + 1][k] += w.w * f[k];
        }
      }
    if ((e - begin) % LOOK_EVERY == LOOK_EVERY - 1 && is_opaque(transmittance, tile, min_transmittance)) end = e + 1;
  }
#if TRUNCATE
  tile_traversed[index] = pack_traversed(end - begin, finite);
#else
  // What lies behind the fragment that made a pixel opaque affects its gradient: the backward traverses all.
  const int entries = tile_starts[index + 1] - begin;
  tile_traversed[index] = pack_traversed(entries, finite && entries == end - begin);
#endif

  vector_t background[BLOCKS];
  copy_row(backgrounds + (size_t)tile.b * CHANNELS, background);
  for (int y = 0; y < tile.height; y++)
    for (int x = 0; x < tile.width; x++) {
      const int p = y * STRIDE + x;
      const size_t at = ((size_t)tile.b * height + tile.top + y) * width + tile.left + x;
      coverage[at] = 1 - transmittance[p];
#pragma unroll
      for (int k = 0; k < BLOCKS; k++) sums[p][k] += transmittance[p] * background[k];
      stream_row(sums[p], image + at * CHANNELS);
    }
}

#ifdef GRAD_FEATURES
// Kernel for the tiles (x0 + i * step_x, y0 + j * step_y): no two of them share a point, so each adds to the
// gradients of its own points only: the first tile that has a point writes, the others add.
kernel void composite_tiles_backward(
    const int height, const int width, const int tiles_y, const int tiles_x, const REAL min_transmittance,
    const int x0, const int y0, const int step_x, const int step_y,
    const long image_stride, const long row_stride, const long pixel_stride, const long channel_stride,
    global const int* restrict tile_starts,        // [B * tiles + 1]
    global const record_t* restrict records,       // [E]
    global const REAL* restrict features,          // [P, C]
    global const REAL* restrict backgrounds,       // [B, C]
    global const int* restrict tile_traversed,     // [B * tiles] from the forward
    global const REAL* restrict grad_image,        // [B, C, H, W] by strides
    global const REAL* restrict grad_coverage,     // [B, H, W]
    global const int* restrict checkpoint_starts,  // [B * tiles]
    global REAL* restrict checkpoints,             // [S, PADDED] scratch
    global int* restrict checkpoint_entries,       // [S] scratch
    global REAL* restrict grad_features,           // [P, C] out
    global REAL* restrict grad_points_uv,          // [P, 2] out
    global REAL* restrict grad_radii,              // [P] out
    global REAL* restrict grad_opacities,          // [P] out
    global REAL* restrict tile_grad_backgrounds)   // [B * tiles, C] out
{
  const int tx = x0 + (int)get_global_id(0) * step_x, ty = y0 + (int)get_global_id(1) * step_y;
  const int index = ((int)get_global_id(2) * tiles_y + ty) * tiles_x + tx;
  const strides_t strides = {image_stride, row_stride, pixel_stride, channel_stride};
  composite_tile_backward(
      index, height, width, tiles_y, tiles_x, min_transmittance, strides, tile_starts, records, features, backgrounds,
      tile_traversed, grad_image, grad_coverage, checkpoint_starts, checkpoints, checkpoint_entries, grad_features,
      grad_points_uv, grad_radii, grad_opacities, tile_grad_backgrounds);
}

#ifdef ONE_ITEM
// All of the backward in one work-item, in the order of the launches that it replaces.
kernel void composite_few_backward(
    const int height, const int width, const int tiles_y, const int tiles_x, const REAL min_transmittance,
    const int batch, const int points, const int step_x, const int step_y,
    const long image_stride, const long row_stride, const long pixel_stride, const long channel_stride,
    global const int* restrict tile_starts,        // [B * tiles + 1]
    global const record_t* restrict records,       // [E]
    global const int* restrict intersections,      // [P]
    global const REAL* restrict features,          // [P, C]
    global const REAL* restrict backgrounds,       // [B, C]
    global const int* restrict tile_traversed,     // [B * tiles] from the forward
    global const REAL* restrict grad_image,        // [B, C, H, W] by strides
    global const REAL* restrict grad_coverage,     // [B, H, W]
    global const int* restrict checkpoint_starts,  // [B * tiles]
    global REAL* restrict checkpoints,             // [S, PADDED] scratch
    global int* restrict checkpoint_entries,       // [S] scratch
    global REAL* restrict grad_features,           // [P, C] out
    global REAL* restrict grad_points_uv,          // [P, 2] out
    global REAL* restrict grad_radii,              // [P] out
    global REAL* restrict grad_opacities,          // [P] out
    global REAL* restrict tile_grad_backgrounds,   // [B * tiles, C] scratch
    global REAL* restrict grad_backgrounds)        // [B, C] out
{
  const strides_t strides = {image_stride, row_stride, pixel_stride, channel_stride};
  const int tiles = tiles_y * tiles_x;
  clear_unlisted(0, points, intersections, grad_features, grad_points_uv, grad_radii, grad_opacities);
  for (int y0 = 0; y0 < step_y; y0++)
    for (int x0 = 0; x0 < step_x; x0++)
      for (int t = 0; t < batch * tiles; t++)
        if (t / tiles_x % tiles_y % step_y == y0 && t % tiles_x % step_x == x0)
          composite_tile_backward(
              t, height, width, tiles_y, tiles_x, min_transmittance, strides, tile_starts, records, features,
              backgrounds, tile_traversed, grad_image, grad_coverage, checkpoint_starts, checkpoints,
              checkpoint_entries, grad_features, grad_points_uv, grad_radii, grad_opacities, tile_grad_backgrounds);
#if GRAD_BACKGROUNDS
  for (int b = 0; b < batch; b++)
    for (int c = 0; c < CHANNELS; c++)
      grad_backgrounds[b * CHANNELS + c] = sum_over_tiles(b, c, tiles, tile_grad_backgrounds);
#endif
}
#endif
#endif
