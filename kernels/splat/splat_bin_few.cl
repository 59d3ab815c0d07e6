// The lists of splat_bin.cl, bit for bit, in one launch of one work-item: few points take less time than launches and
// the wait for the lists' length, which is bounded instead.
#include "common.h"
#include "splat.h"
#include "prefetch.h"
#include "splat_lists.h"

kernel void list_few(
    const int height, const int width, const int tiles_y, const int tiles_x, const int batch,
    global const int* restrict cloud_starts,  // [B + 1]
    global const REAL* restrict points_uv,    // [P, 2]
    global const REAL* restrict z,            // [P]
    global const REAL* restrict radii,        // [P]
    global const REAL* restrict opacities,    // [P]
    const int list_transparent,               // 0: points of opacity 0 are left out
    global int* restrict intersections,       // [P] out: see pack_intersections
    global int* restrict next,                // [B * tiles] scratch
    global entry_t* restrict entries,         // [P * tiles] scratch
    global entry_t* restrict scratch,         // [P * tiles] scratch
    global record_t* restrict records,        // [P * tiles] out
    global int* restrict tile_starts,         // [B * tiles + 1] out
    global long* restrict tile_scratch,       // [B * tiles] out: pixels of the quads of all footprints
    global int* restrict extent)              // [1] out: most tiles that a footprint covers along an axis
{
  const int tiles = tiles_y * tiles_x;
  int most = 1, begin = 0;
  for (int b = 0; b < batch; b++) {
    const range_t cloud = chunk_of(cloud_starts, 0, 1, b);
    const int covered = count_chunk(
        cloud, height, width, tiles_y, tiles_x, points_uv, z, radii, opacities, list_transparent, intersections,
        next + b * tiles);
    most = larger_of(most, covered);
    for (int t = b * tiles; t < (b + 1) * tiles; t++) {
      const int count = next[t];
      tile_starts[t] = next[t] = begin;
      begin += count;
    }
    fill_chunk(cloud, height, width, tiles_x, points_uv, z, radii, intersections, next + b * tiles, entries);
  }
  tile_starts[batch * tiles] = begin;
  *extent = most;
  for (int t = 0; t < batch * tiles; t++) {
    const int first = tile_starts[t];
    tile_scratch[t] = sort_tile(
        t, tile_starts[t + 1] - first, tiles_y, tiles_x, height, width, smaller_of(most, tiles_y),
        smaller_of(most, tiles_x), points_uv, radii, opacities, entries + first, scratch + first, records + first);
  }
}
