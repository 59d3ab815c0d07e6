// From points to depth-sorted tile lists, without atomics.
#include "common.h"
#include "splat.h"

#define STRIP 128

kernel void count_tiles(
    const int height, const int width, const int tiles_y, const int tiles_x,
    global const int* restrict cloud_starts,  // [B + 1]
    global const REAL* restrict points_uv,    // [P, 2]
    global const REAL* restrict z,            // [P]
    global const REAL* restrict radii,        // [P]
    global const REAL* restrict opacities,    // [P]
    global int* restrict places,              // [P] out
    global int* restrict counts,              // [B, chunks, tiles] out
    global int* restrict spans)               // [B, chunks] out: most tiles a footprint covers along an axis
{
  const int c = get_global_id(0), b = get_global_id(1), chunks = get_global_size(0);
  const int tiles = tiles_y * tiles_x;
  const int points = cloud_starts[b + 1] - cloud_starts[b];
  const int begin = cloud_starts[b] + (int)((long)points * c / chunks);
  const int end = cloud_starts[b] + (int)((long)points * (c + 1) / chunks);
  global int* mine = counts + ((size_t)b * chunks + c) * tiles;
  for (int t = 0; t < tiles; t++) mine[t] = 0;
  int span = 1;
  for (int strip = begin; strip < end; strip += STRIP) {
    const int stop = min(strip + STRIP, end);
    for (int i = strip; i < stop; i++) {
      const REAL u = points_uv[2 * (size_t)i], v = points_uv[2 * (size_t)i + 1];
      const box_t box = footprint(u, v, radii[i], height, width);
      const bool some = drawable(u, v, z[i], radii[i], opacities[i]) & (box.x0 < box.x1) & (box.y0 < box.y1);
      const int tx = box.x0 / TILE, ty = box.y0 / TILE;
      const int columns = (box.x1 - 1) / TILE - tx, rows = (box.y1 - 1) / TILE - ty;
      const int s = some ? max(columns, rows) : 0;
      span = max(span, s + 1);
      places[i] = some ? pack_place(ty * tiles_x + tx, rows, columns) : -1;
    }
    for (int i = strip; i < stop; i++) {
      const int place = places[i];
      if (place < 0) continue;
      int columns = place & MANY, rows = place >> MORE_BITS & MANY;
      const int first = place >> 2 * MORE_BITS;
      if (!(columns | rows)) { mine[first]++; continue; }
      if (columns == MANY || rows == MANY) {
        const box_t box = footprint(points_uv[2 * (size_t)i], points_uv[2 * (size_t)i + 1], radii[i], height, width);
        columns = (box.x1 - 1) / TILE - box.x0 / TILE;
        rows = (box.y1 - 1) / TILE - box.y0 / TILE;
      }
      for (int y = 0; y <= rows; y++)
        for (int x = 0; x <= columns; x++) mine[first + y * tiles_x + x]++;
    }
  }
  spans[b * chunks + c] = span;
}

// One work-item a tile (t, b): its counts become where each chunk starts within the tile.
kernel void scan_chunks(
    const int chunks, const int tiles,
    global int* restrict counts,        // [B, chunks, tiles] in, exclusive sums over chunks out
    global int* restrict tile_counts)   // [B, tiles] out
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
    global int* restrict counts,              // [B, chunks, tiles] in: cursors; used up
    global entry_t* restrict entries)         // [E] out
{
  const int c = get_global_id(0), b = get_global_id(1), chunks = get_global_size(0);
  const int tiles = tiles_y * tiles_x;
  const int points = cloud_starts[b + 1] - cloud_starts[b];
  const int begin = cloud_starts[b] + (int)((long)points * c / chunks);
  const int end = cloud_starts[b] + (int)((long)points * (c + 1) / chunks);
  global int* mine = counts + ((size_t)b * chunks + c) * tiles;
  global const int* starts = tile_starts + b * tiles;
  for (int t = 0; t < tiles; t++) mine[t] += starts[t];
  for (int i = begin; i < end; i++) {
    const int place = places[i];
    if (place < 0) continue;
    int columns = place & MANY, rows = place >> MORE_BITS & MANY;
    const int first = place >> 2 * MORE_BITS;
    const entry_t entry = {AS_KEY(z[i]), i};
    if (!(columns | rows)) { entries[mine[first]++] = entry; continue; }
    if (columns == MANY || rows == MANY) {
      const box_t box = footprint(points_uv[2 * (size_t)i], points_uv[2 * (size_t)i + 1], radii[i], height, width);
      columns = (box.x1 - 1) / TILE - box.x0 / TILE;
      rows = (box.y1 - 1) / TILE - box.y0 / TILE;
    }
    for (int y = 0; y <= rows; y++)
      for (int x = 0; x <= columns; x++) entries[mine[first + y * tiles_x + x]++] = entry;
  }
}

#define DIGIT_BITS 8
#define DIGITS (1 << DIGIT_BITS)
#define DIGIT(key, low) ((int)((key) >> (low)) & (DIGITS - 1))

// Stable counting sort of n entries by two digits, from bit `low` on: a to b to a.
inline void sort_two_digits(global entry_t* a, global entry_t* b, int n, int low) {
  int cursor0[DIGITS], cursor1[DIGITS];
  for (int d = 0; d < DIGITS; d++) cursor0[d] = cursor1[d] = 0;
  for (int i = 0; i < n; i++) {
    const key_bits key = a[i].key;
    cursor0[DIGIT(key, low)]++;
    cursor1[DIGIT(key, low + DIGIT_BITS)]++;
  }
  int sum0 = 0, sum1 = 0;
  for (int d = 0; d < DIGITS; d++) {
    const int count0 = cursor0[d], count1 = cursor1[d];
    cursor0[d] = sum0;
    cursor1[d] = sum1;
    sum0 += count0;
    sum1 += count1;
  }
  for (int i = 0; i < n; i++) { const entry_t e = a[i]; b[cursor0[DIGIT(e.key, low)]++] = e; }
  for (int i = 0; i < n; i++) { const entry_t e = b[i]; a[cursor1[DIGIT(e.key, low + DIGIT_BITS)]++] = e; }
}

// What compositing needs of point id in the tile at (top, left).
inline record_t record_of(
    size_t id, int top, int left, int height, int width, global const REAL* points_uv, global const REAL* radii,
    global const REAL* opacities) {
  record_t record;
  record.u = points_uv[2 * id];
  record.v = points_uv[2 * id + 1];
  record.r = radii[id];
  record.o = opacities[id];
  record.r2 = record.r * record.r;
  record.slope = record.o / record.r2;
  record.id = id;
  const box_t box = footprint(record.u, record.v, record.r, height, width);
  const box_t inside = {max(box.x0 - left, 0), max(box.y0 - top, 0), min(box.x1 - left, TILE), min(box.y1 - top, TILE)};
  record.box = pack_box(inside, area_of(inside) == area_of(box));
  return record;
}

kernel void sort_tiles(
    const int height, const int width, const int tiles_y, const int tiles_x,
    global const int* restrict tile_starts,   // [B * tiles + 1]
    global const REAL* restrict points_uv,    // [P, 2]
    global const REAL* restrict radii,        // [P]
    global const REAL* restrict opacities,    // [P]
    global entry_t* restrict entries, global entry_t* restrict room,
    global record_t* restrict records,        // [E] out
    global long* restrict tile_slots)         // [B * tiles] out
{
  const int t = get_global_id(0);
  const int begin = tile_starts[t], n = tile_starts[t + 1] - begin;
  tile_slots[t] = 0;
  if (n == 0) return;
  global entry_t* a = entries + begin;
  key_bits differ = 0;
  const key_bits first = a[0].key;
  for (int i = 1; i < n; i++) differ |= a[i].key ^ first;
  if (differ) {
    const int high = REAL_BITS - (int)clz(differ);
    bool done = false;
    if (n > 24) sort_two_digits(a, room + begin, n, max(high - 2 * DIGIT_BITS, 0));
    long budget = 8 * (long)n + 600;
    for (int i = 1; i < n && budget > 0; i++) {
      const entry_t e = a[i];
      int j = i;
      for (; j > 0 && a[j - 1].key > e.key; j--) a[j] = a[j - 1];
      a[j] = e;
      budget -= i - j;
    }
    if (budget <= 0)
      for (int low = 0; low < high; low += 2 * DIGIT_BITS) sort_two_digits(a, room + begin, n, low);
  }
  const int tiles = tiles_x * tiles_y;
  const int top = t % tiles / tiles_x * TILE, left = t % tiles_x * TILE;
  long slots = 0;
  for (int i = 0; i < n; i++) {
    const record_t record = record_of(a[i].id, top, left, height, width, points_uv, radii, opacities);
    records[begin + i] = record;
    slots += 4 * quads_in(unpack_box(record.box));
  }
  tile_slots[t] = slots;
}

#ifdef TOGETHER
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
      const int start = i / (2 * run) * (2 * run), middle = min(start + run, n), stop = min(start + 2 * run, n);
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
  const int first = min(lane * share, n), stop = min(first + share, n);
  long slots = 0;
  for (int i = first; i < stop; i++) {
    const record_t record = record_of(a[i].id, top, left, height, width, points_uv, radii, opacities);
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
