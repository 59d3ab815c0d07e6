// From points to depth-sorted tile lists, without atomics, so that every run makes the same lists.
//
// 1. count_tiles   One work-item walks a chunk of points, in order, and counts how many reach each tile.
// 2. scan_chunks   For each tile, the counts become where each chunk starts in the tile's list.
//                  (The host sums the tiles' totals, for it has to allocate the lists.)
// 3. fill_tiles    Each chunk writes its points from there on: every list is in the order of the index.
// 4. sort_tiles    Each list is sorted by z. The sort is stable, so equal depths stay in the order of the index, and
//                  what compositing needs of each point is gathered into the list, to be read in sequence.
//
//   TOGETHER   defined: sort_tiles_together, a work-group a tile (for GPUs), instead of sort_tiles, a work-item a tile
#include "common.h"
#include "splat.h"
#include "prefetch.h"

// Points whose tiles are found at a time, in a loop that compilers turn into vector code.
#define STRIP 128

typedef struct { int begin, end; } range_t;

// The points of chunk c of cloud b.
inline range_t chunk_of(global const int* cloud_starts, int c, int chunks, int b) {
  const int first = cloud_starts[b];
  const long points = cloud_starts[b + 1] - first;
  const range_t chunk = {first + (int)(points * c / chunks), first + (int)(points * (c + 1) / chunks)};
  return chunk;
}

// How many rows and columns of tiles a point has more than one. x: columns, y: rows.
inline int2 more_tiles(
    int place, int i, int height, int width, global const REAL* points_uv, global const REAL* radii) {
  const int2 more = (int2)(place & MANY, (place >> MORE_BITS) & MANY);
  if (more.x < MANY && more.y < MANY) return more;
  const box_t box = footprint(points_uv[2 * (size_t)i], points_uv[2 * (size_t)i + 1], radii[i], height, width);
  return (int2)((box.x1 - 1) / TILE - box.x0 / TILE, (box.y1 - 1) / TILE - box.y0 / TILE);
}

kernel void count_tiles(
    const int height, const int width, const int tiles_y, const int tiles_x,
    global const int* restrict cloud_starts,  // [B + 1]
    global const REAL* restrict points_uv,    // [P, 2]
    global const REAL* restrict z,            // [P]
    global const REAL* restrict radii,        // [P]
    global const REAL* restrict opacities,    // [P]
    const int list_transparent,               // 0: points of opacity 0 are left out
    global int* restrict places,              // [P] out: see pack_place
    global int* restrict counts,              // [B, chunks, tiles] out
    global int* restrict spans)               // [B, chunks] out: most tiles that a footprint covers along an axis
{
  const int c = get_global_id(0), chunks = get_global_size(0), b = get_global_id(1);
  const int tiles = tiles_y * tiles_x;
  const range_t chunk = chunk_of(cloud_starts, c, chunks, b);
  global int* mine = counts + ((size_t)b * chunks + c) * tiles;
  for (int t = 0; t < tiles; t++) mine[t] = 0;
  int span = 1;
  for (int strip = chunk.begin; strip < chunk.end; strip += STRIP) {
    const int end = smaller_of(strip + STRIP, chunk.end);
    for (int i = strip; i < end; i++) {
      const REAL u = points_uv[2 * (size_t)i], v = points_uv[2 * (size_t)i + 1];
      const box_t box = footprint(u, v, radii[i], height, width);
      const bool seen = drawable(u, v, z[i], radii[i], opacities[i]) & !is_empty(box) &
                        (list_transparent | (opacities[i] != 0));
      const int x = box.x0 / TILE, y = box.y0 / TILE;
      const int columns = (box.x1 - 1) / TILE - x, rows = (box.y1 - 1) / TILE - y;
      span = larger_of(span, seen ? larger_of(columns, rows) + 1 : 1);
      places[i] = seen ? pack_place(y * tiles_x + x, rows, columns) : -1;
    }
    for (int i = strip; i < end; i++) {
      const int place = places[i];
      if (place < 0) continue;
      if (is_in_one_tile(place)) {
        mine[first_tile(place)]++;
        continue;
      }
      const int2 more = more_tiles(place, i, height, width, points_uv, radii);
      for (int y = 0; y <= more.y; y++)
        for (int x = 0; x <= more.x; x++) mine[first_tile(place) + y * tiles_x + x]++;
    }
  }
  spans[b * chunks + c] = span;
}

// One work-item a tile.
kernel void scan_chunks(
    const int chunks, const int tiles,
    global int* restrict counts,       // [B, chunks, tiles] in; out: the sums over the chunks before
    global int* restrict tile_counts)  // [B, tiles] out
{
  const int t = get_global_id(0), b = get_global_id(1);
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
    global const int* restrict cloud_starts,  // [B + 1]
    global const REAL* restrict points_uv,    // [P, 2]
    global const REAL* restrict z,            // [P]
    global const REAL* restrict radii,        // [P]
    global const int* restrict places,        // [P]
    global const int* restrict tile_starts,   // [B * tiles + 1]
    global int* restrict counts,              // [B, chunks, tiles] in, used up: where in the list a chunk writes next
    global entry_t* restrict entries)         // [E] out
{
  const int c = get_global_id(0), chunks = get_global_size(0), b = get_global_id(1);
  const int tiles = tiles_y * tiles_x;
  const range_t chunk = chunk_of(cloud_starts, c, chunks, b);
  global int* next = counts + ((size_t)b * chunks + c) * tiles;
  for (int t = 0; t < tiles; t++) next[t] += tile_starts[b * tiles + t];
  for (int i = chunk.begin; i < chunk.end; i++) {
    const int place = places[i];
    if (place < 0) continue;
    const entry_t entry = {AS_KEY(z[i]), i};
    if (is_in_one_tile(place)) {
      entries[next[first_tile(place)]++] = entry;
      continue;
    }
    const int2 more = more_tiles(place, i, height, width, points_uv, radii);
    for (int y = 0; y <= more.y; y++)
      for (int x = 0; x <= more.x; x++) entries[next[first_tile(place) + y * tiles_x + x]++] = entry;
  }
}

// What compositing needs of point id in the tile at (top, left).
inline record_t record_of(
    size_t id, int top, int left, int height, int width, box_t firsts, global const REAL* points_uv,
    global const REAL* radii, global const REAL* opacities) {
  record_t record;
  record.u = points_uv[2 * id];
  record.v = points_uv[2 * id + 1];
  record.r = radii[id];
  record.o = opacities[id];
  record.id = id;
  const box_t box = footprint(record.u, record.v, record.r, height, width);
  const box_t inside = {larger_of(box.x0 - left, 0), larger_of(box.y0 - top, 0), smaller_of(box.x1 - left, TILE), smaller_of(box.y1 - top, TILE)};
  record.box = pack_box(inside, is_inside(box, firsts));
  return record;
}

#ifndef TOGETHER
#define DIGIT_BITS 8
#define DIGITS (1 << DIGIT_BITS)
#define DIGIT(key, low) ((int)((key) >> (low)) & (DIGITS - 1))
// Shorter lists are sorted by insertion alone.
#define FEW 24

// Stable counting sort of a[0, n) by the two digits from bit `low` on, by way of room.
inline void sort_by_two_digits(global entry_t* a, global entry_t* room, int n, int low) {
  int first[DIGITS], second[DIGITS];
  for (int d = 0; d < DIGITS; d++) first[d] = second[d] = 0;
  for (int i = 0; i < n; i++) {
    first[DIGIT(a[i].key, low)]++;
    second[DIGIT(a[i].key, low + DIGIT_BITS)]++;
  }
  int firsts = 0, seconds = 0;
  for (int d = 0; d < DIGITS; d++) {
    const int here = first[d], there = second[d];
    first[d] = firsts;
    second[d] = seconds;
    firsts += here;
    seconds += there;
  }
  for (int i = 0; i < n; i++) room[first[DIGIT(a[i].key, low)]++] = a[i];
  for (int i = 0; i < n; i++) a[second[DIGIT(room[i].key, low + DIGIT_BITS)]++] = room[i];
}

// Stable sort of a[0, n) by key. The two highest digits that differ are sorted by counting, which leaves little for
// the insertion sort after them. Where it is not little (many depths that differ in the last digits alone), counting
// goes on from the lowest digit: both are stable, so equal keys still are in the order of the index.
inline void sort_list(global entry_t* a, global entry_t* room, int n) {
  key_bits differing = 0;
  for (int i = 1; i < n; i++) differing |= a[i].key ^ a[0].key;
  if (differing == 0) return;
  const int high = REAL_BITS - (int)clz(differing);
  if (n > FEW) sort_by_two_digits(a, room, n, larger_of(high - 2 * DIGIT_BITS, 0));
  long moves_left = 8 * (long)n + FEW * FEW;
  for (int i = 1; i < n && moves_left > 0; i++) {
    const entry_t entry = a[i];
    int to = i;
    for (; to > 0 && a[to - 1].key > entry.key; to--) a[to] = a[to - 1];
    a[to] = entry;
    moves_left -= i - to;
  }
  if (moves_left <= 0)
    for (int low = 0; low < high; low += 2 * DIGIT_BITS) sort_by_two_digits(a, room, n, low);
}

// One work-item a tile.
kernel void sort_tiles(
    const int height, const int width, const int tiles_y, const int tiles_x,
    const int step_y, const int step_x,  // of the backward, see first_box
    global const int* restrict tile_starts,   // [B * tiles + 1]
    global const REAL* restrict points_uv,    // [P, 2]
    global const REAL* restrict radii,        // [P]
    global const REAL* restrict opacities,    // [P]
    global entry_t* restrict entries,         // [E] in, overwritten
    global entry_t* restrict room,            // [E] room for the sort
    global record_t* restrict records,        // [E] out
    global long* restrict tile_slots)         // [B * tiles] out: pixels of the quads of all footprints
{
  const int t = get_global_id(0);
  const int begin = tile_starts[t], n = tile_starts[t + 1] - begin;
  const int tiles = tiles_x * tiles_y, top = t % tiles / tiles_x * TILE, left = t % tiles_x * TILE;
  for (int i = begin; i < begin + n; i++) {  // in the order of the index, close together; after the sort they are not
    const size_t id = entries[i].id;
    PREFETCH(points_uv + 2 * id);
    PREFETCH(radii + id);
    PREFETCH(opacities + id);
  }
  sort_list(entries + begin, room + begin, n);
  const box_t firsts = first_box(top / TILE, left / TILE, step_y, step_x);
  long slots = 0;
  for (int i = begin; i < begin + n; i++) {
    const record_t record = record_of(entries[i].id, top, left, height, width, firsts, points_uv, radii, opacities);
    records[i] = record;
    slots += 4 * quads_in(unpack_box(record.box));
  }
  tile_slots[t] = slots;
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

// The same lists by one work-group a tile, for GPUs: merge sort, where each entry finds its rank in the other half.
kernel void sort_tiles_together(
    const int height, const int width, const int tiles_y, const int tiles_x,
    const int step_y, const int step_x,  // of the backward, see first_box
    global const int* restrict tile_starts,                    // [B * tiles + 1]
    global const REAL* restrict points_uv,                     // [P, 2]
    global const REAL* restrict radii,                         // [P]
    global const REAL* restrict opacities,                     // [P]
    global entry_t* entries, global entry_t* room,             // [E] in, overwritten; [E] room
    global record_t* restrict records,                         // [E] out
    global long* restrict tile_slots,                          // [B * tiles] out: pixels of all footprints
    global long* restrict slot_starts)                         // [E] out: pixels of the footprints before, in the tile
{
  local long partial[GROUP + 1];
  const int t = get_group_id(0), lane = get_local_id(0);
  const int begin = tile_starts[t], n = tile_starts[t + 1] - begin;
  global entry_t* a = entries + begin;
  global entry_t* b = room + begin;
  for (int run = 1; run < n; run *= 2) {
    for (int i = lane; i < n; i += GROUP) {
      const int start = i / (2 * run) * (2 * run), middle = smaller_of(start + run, n), stop = smaller_of(start + 2 * run, n);
      const key_bits key = a[i].key;
      const int before = i < middle ? i + rank_in(a + middle, stop - middle, key, false)
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
  long slots = 0;
  for (int i = first; i < stop; i++) {
    const record_t record = record_of(a[i].id, top, left, height, width, firsts, points_uv, radii, opacities);
    records[begin + i] = record;
    slot_starts[begin + i] = slots;
    slots += area_of(unpack_box(record.box));
  }
  partial[lane + 1] = slots;
  barrier(CLK_LOCAL_MEM_FENCE);
  if (lane == 0) {
    partial[0] = 0;
    for (int i = 1; i <= GROUP; i++) partial[i] += partial[i - 1];
    tile_slots[t] = partial[GROUP];
  }
  barrier(CLK_LOCAL_MEM_FENCE);
  for (int i = first; i < stop; i++) slot_starts[begin + i] += partial[lane];
}
#endif
