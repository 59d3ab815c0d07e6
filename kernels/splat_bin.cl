// From points to depth-sorted tile lists, without atomics.
#include "common.h"
#include "splat.h"

#define SPAN_BITS 2
#define SPAN_MASK ((1 << SPAN_BITS) - 1)
#define GROUP 128

// tile << 2 * SPAN_BITS | rows - 1 << SPAN_BITS | columns - 1, or -1
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
  for (int group = begin; group < end; group += GROUP) {
    const int stop = min(group + GROUP, end);
    for (int i = group; i < stop; i++) {
      const REAL u = points_uv[2 * (size_t)i], v = points_uv[2 * (size_t)i + 1];
      const box_t box = footprint(u, v, radii[i], height, width);
      const bool some = drawable(u, v, z[i], radii[i], opacities[i]) & (box.x0 < box.x1) & (box.y0 < box.y1);
      const int tx = box.x0 / TILE, ty = box.y0 / TILE;
      const int columns = (box.x1 - 1) / TILE - tx, rows = (box.y1 - 1) / TILE - ty;
      const int s = some ? max(columns, rows) : 0;
      span = max(span, s + 1);
      const int place = (ty * tiles_x + tx) << 2 * SPAN_BITS | min(rows, SPAN_MASK) << SPAN_BITS | min(columns, SPAN_MASK);
      places[i] = some ? place : -1;
    }
    for (int i = group; i < stop; i++) {
      const int place = places[i];
      if (place < 0) continue;
      int columns = place & SPAN_MASK, rows = place >> SPAN_BITS & SPAN_MASK;
      const int first = place >> 2 * SPAN_BITS;
      if (!(columns | rows)) { mine[first]++; continue; }
      if (columns == SPAN_MASK || rows == SPAN_MASK) {
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
    int columns = place & SPAN_MASK, rows = place >> SPAN_BITS & SPAN_MASK;
    const int first = place >> 2 * SPAN_BITS;
    const entry_t entry = {AS_KEY(z[i]), i};
    if (!(columns | rows)) { entries[mine[first]++] = entry; continue; }
    if (columns == SPAN_MASK || rows == SPAN_MASK) {
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
    const key_t_ key = a[i].key;
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

kernel void sort_tiles(
    const int height, const int width, const int tiles_y, const int tiles_x,
    global const int* restrict tile_starts,   // [B * tiles + 1]
    global const REAL* restrict points_uv,    // [P, 2]
    global const REAL* restrict radii,        // [P]
    global const REAL* restrict opacities,    // [P]
    global entry_t* restrict entries, global entry_t* restrict room,
    global record_t* restrict records)        // [E] out
{
  const int t = get_global_id(0);
  const int begin = tile_starts[t], n = tile_starts[t + 1] - begin;
  if (n == 0) return;
  global entry_t* a = entries + begin;
  key_t_ differ = 0;
  const key_t_ first = a[0].key;
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
  const int rows = min(TILE, height - top), columns = min(TILE, width - left);
  for (int i = 0; i < n; i++) {
    const size_t id = a[i].id;
    record_t out;
    out.u = points_uv[2 * id];
    out.v = points_uv[2 * id + 1];
    out.r = radii[id];
    out.o = opacities[id];
    out.r2 = out.r * out.r;
    out.slope = out.o / out.r2;
    out.id = id;
    const int x0 = first_pixel(out.u - out.r - left, columns), x1 = last_pixel(out.u + out.r - left, columns);
    const int y0 = first_pixel(out.v - out.r - top, rows), y1 = last_pixel(out.v + out.r - top, rows);
    out.box = x0 | x1 << 8 | y0 << 16 | y1 << 24;
    records[begin + i] = out;
  }
}
