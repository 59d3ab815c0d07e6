// From points to depth-sorted tile lists, without atomics, so that every run makes the same lists.
//
// 1. count_tiles   One work-item traverses a chunk of points, in order, and counts how many reach each tile.
// 2. scan_chunks   For each tile, the counts become where each chunk starts in the tile's list.
//                  (The host sums the tiles' totals, for it has to allocate the lists.)
// 3. fill_tiles    Each chunk writes its points from there on: every list is in the order of the index.
// 4. sort_tiles    Each list is sorted by z. The sort is stable, so equal depths stay in the order of the index, and
//                  what compositing needs of each point is gathered into the list, to be read in sequence.
//
// Few points take fewer launches, see splat_bin_few.cl.
//
//   TOGETHER   defined: sort_tiles_together, one work-group per tile (for GPUs), instead of sort_tiles
#include "common.h"
#include "splat.h"
#include "prefetch.h"
#include "splat_lists.h"

kernel void count_tiles(
    const int height, const int width, const int tiles_y, const int tiles_x,
    global const int* restrict cloud_starts,  // [B + 1]
    global const REAL* restrict points_uv,    // [P, 2]
    global const REAL* restrict z,            // [P]
    global const REAL* restrict radii,        // [P]
    global const REAL* restrict opacities,    // [P]
    const int list_transparent,               // 0: points of opacity 0 are left out
    global int* restrict intersections,       // [P] out: see pack_intersections
    global int* restrict counts,              // [B, chunks, tiles] out
    global int* restrict extents)             // [B, chunks] out: most tiles that a footprint covers along an axis
{
  const int c = get_global_id(0), chunks = get_global_size(0), b = get_global_id(1);
  extents[b * chunks + c] = count_chunk(
      chunk_of(cloud_starts, c, chunks, b), height, width, tiles_y, tiles_x, points_uv, z, radii, opacities,
      list_transparent, intersections, counts + ((size_t)b * chunks + c) * tiles_y * tiles_x);
}

// One work-item per tile.
kernel void scan_chunks(
    const int chunks, const int tiles,
    global int* restrict counts,       // [B, chunks, tiles] in; out: the sums over the chunks before
    global int* restrict tile_counts)  // [B, tiles] out
{
  const int t = get_global_id(0), b = get_global_id(1);
  if (t >= tiles) return;
  int sum = 0;
  for (int c = 0; c < chunks; c++) {
    global int* at = counts + ((size_t)b * chunks + c) * tiles + t;
    const int count = *at;
    *at = sum;
    sum += count;
  }
  tile_counts[b * tiles + t] = sum;
}

kernel void fill_tiles(
    const int height, const int width, const int tiles_y, const int tiles_x,
    global const int* restrict cloud_starts,   // [B + 1]
    global const REAL* restrict points_uv,     // [P, 2]
    global const REAL* restrict z,             // [P]
    global const REAL* restrict radii,         // [P]
    global const int* restrict intersections,  // [P]
    global const int* restrict tile_starts,    // [B * tiles + 1]
    global int* restrict counts,               // [B, chunks, tiles] in, used up: where in the list a chunk writes next
    global entry_t* restrict entries)          // [E] out
{
  const int c = get_global_id(0), chunks = get_global_size(0), b = get_global_id(1);
  const int tiles = tiles_y * tiles_x;
  global int* next = counts + ((size_t)b * chunks + c) * tiles;
  for (int t = 0; t < tiles; t++) next[t] += tile_starts[b * tiles + t];
  fill_chunk(
      chunk_of(cloud_starts, c, chunks, b), height, width, tiles_x, points_uv, z, radii, intersections, next, entries);
}

#ifndef TOGETHER
// One work-item per tile.
kernel void sort_tiles(
    const int height, const int width, const int tiles_y, const int tiles_x,
    const int step_y, const int step_x,      // of the backward, see first_box
    global const int* restrict tile_starts,  // [B * tiles + 1]
    global const REAL* restrict points_uv,   // [P, 2]
    global const REAL* restrict radii,       // [P]
    global const REAL* restrict opacities,   // [P]
    global entry_t* restrict entries,        // [E] in, overwritten
    global entry_t* restrict scratch,        // [E] scratch of the sort
    global record_t* restrict records,       // [E] out
    global long* restrict tile_scratch)      // [B * tiles] out: pixels of the quads of all footprints
{
  const int t = get_global_id(0), begin = tile_starts[t];
  tile_scratch[t] = sort_tile(
      t, tile_starts[t + 1] - begin, tiles_y, tiles_x, height, width, step_y, step_x, points_uv, radii, opacities,
      entries + begin, scratch + begin, records + begin);
}
#else
#define GROUP (TILE * TILE)

// Entries of a[0, n), sorted by key, that come before an entry of this key: smaller ones, and equal ones if asked for.
inline int rank_in(global const entry_t* a, int n, key_bits key, bool equal_too) {
  int low = 0, high = n;
  while (low < high) {
    const int middle = (low + high) / 2;
    if (a[middle].key < key || (equal_too && a[middle].key == key)) low = middle + 1;
    else high = middle;
  }
  return low;
}

// The same lists by one work-group per tile, for GPUs: merge sort, where each entry finds its rank in the other half.
kernel __attribute__((reqd_work_group_size(GROUP, 1, 1))) void sort_tiles_together(
    const int height, const int width, const int tiles_y, const int tiles_x,
    const int step_y, const int step_x,                // of the backward, see first_box
    global const int* restrict tile_starts,            // [B * tiles + 1]
    global const REAL* restrict points_uv,             // [P, 2]
    global const REAL* restrict radii,                 // [P]
    global const REAL* restrict opacities,             // [P]
    global entry_t* entries, global entry_t* scratch,  // [E] in, overwritten; [E] scratch
    global record_t* restrict records,                 // [E] out
    global long* restrict tile_scratch,                // [B * tiles] out: pixels of all footprints
    global long* restrict entry_offsets)               // [E] out: pixels of the footprints before, in the tile
{
  local long partial[GROUP + 1];
  const int t = get_group_id(0), lane = get_local_id(0);
  const int begin = tile_starts[t], n = tile_starts[t + 1] - begin;
  global entry_t* a = entries + begin;
  global entry_t* b = scratch + begin;
  for (int run = 1; run < n; run *= 2) {
    for (int i = lane; i < n; i += GROUP) {
      const int start = i / (2 * run) * (2 * run);
      const int middle = smaller_of(start + run, n), stop = smaller_of(start + 2 * run, n);
      const key_bits key = a[i].key;
      const bool in_order = middle == stop || a[middle - 1].key <= a[middle].key;
      const int before = in_order     ? i
                         : i < middle ? i + rank_in(a + middle, stop - middle, key, false)
                                      : i - run + rank_in(a + start, run, key, true);
      b[before] = a[i];
    }
    barrier(CLK_GLOBAL_MEM_FENCE);
    global entry_t* swap = a;
    a = b;
    b = swap;
  }
  const int tiles = tiles_x * tiles_y;
  const int top = t % tiles / tiles_x * TILE, left = t % tiles_x * TILE;
  const int share = (n + GROUP - 1) / GROUP;
  const int first = smaller_of(lane * share, n), stop = smaller_of(first + share, n);
  const box_t firsts = first_box(top / TILE, left / TILE, step_y, step_x);
  long size = 0;
  for (int i = first; i < stop; i++) {
    const record_t record = record_of(a[i].id, top, left, height, width, firsts, points_uv, radii, opacities);
    records[begin + i] = record;
    entry_offsets[begin + i] = size;
    size += area_of(unpack_box(record.box));
  }
  partial[lane + 1] = size;
  barrier(CLK_LOCAL_MEM_FENCE);
  if (lane == 0) {
    partial[0] = 0;
    for (int i = 1; i <= GROUP; i++) partial[i] += partial[i - 1];
    tile_scratch[t] = partial[GROUP];
  }
  barrier(CLK_LOCAL_MEM_FENCE);
  for (int i = first; i < stop; i++) entry_offsets[begin + i] += partial[lane];
}
#endif
