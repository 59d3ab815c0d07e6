// The steps from points to depth-sorted tile lists, for one chunk of points or one tile: splat_bin.cl distributes
// them over work-items, splat_bin_few.cl runs them in one. After splat.h and prefetch.h.
//
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

// How many rows and columns of tiles a point covers beyond the first. x: columns, y: rows.
inline int2 more_tiles(
    int packed, int i, int height, int width, global const REAL* points_uv, global const REAL* radii) {
  const int2 more = (int2)(packed & MANY, (packed >> MORE_BITS) & MANY);
  if (more.x < MANY && more.y < MANY) return more;
  const box_t box = footprint(points_uv[2 * (size_t)i], points_uv[2 * (size_t)i + 1], radii[i], height, width);
  return (int2)((box.x1 - 1) / TILE - box.x0 / TILE, (box.y1 - 1) / TILE - box.y0 / TILE);
}

// Count how many points of a chunk reach each tile; most tiles that a footprint covers along an axis.
inline int count_chunk(
    range_t chunk, int height, int width, int tiles_y, int tiles_x, global const REAL* restrict points_uv,
    global const REAL* restrict z, global const REAL* restrict radii, global const REAL* restrict opacities,
    int list_transparent, global int* restrict intersections, global int* restrict counts) {
  for (int t = 0; t < tiles_y * tiles_x; t++) counts[t] = 0;
  int extent = 1;
  for (int strip = chunk.begin; strip < chunk.end; strip += STRIP) {
    const int end = smaller_of(strip + STRIP, chunk.end);
    for (int i = strip; i < end; i++) {
      const REAL u = points_uv[2 * (size_t)i], v = points_uv[2 * (size_t)i + 1];
      const box_t box = footprint(u, v, radii[i], height, width);
      const bool seen = drawable(u, v, z[i], radii[i], opacities[i]) & !is_empty(box) &
                        (list_transparent | (opacities[i] != 0));
      const int x = box.x0 / TILE, y = box.y0 / TILE;
      const int columns = (box.x1 - 1) / TILE - x, rows = (box.y1 - 1) / TILE - y;
      extent = larger_of(extent, seen ? larger_of(columns, rows) + 1 : 1);
      intersections[i] = seen ? pack_intersections(y * tiles_x + x, rows, columns) : -1;
    }
    for (int i = strip; i < end; i++) {
      const int packed = intersections[i];
      if (packed < 0) continue;
      if (is_in_one_tile(packed)) {
        counts[first_tile(packed)]++;
        continue;
      }
      const int2 more = more_tiles(packed, i, height, width, points_uv, radii);
      for (int y = 0; y <= more.y; y++)
        for (int x = 0; x <= more.x; x++) counts[first_tile(packed) + y * tiles_x + x]++;
    }
  }
  return extent;
}

// Write a chunk's points into the lists, tile t's from next[t] on.
inline void fill_chunk(
    range_t chunk, int height, int width, int tiles_x, global const REAL* restrict points_uv,
    global const REAL* restrict z, global const REAL* restrict radii, global const int* restrict intersections,
    global int* restrict next, global entry_t* restrict entries) {
  for (int i = chunk.begin; i < chunk.end; i++) {
    const int packed = intersections[i];
    if (packed < 0) continue;
    const entry_t entry = {AS_KEY(z[i]), i};
    if (is_in_one_tile(packed)) {
      entries[next[first_tile(packed)]++] = entry;
      continue;
    }
    const int2 more = more_tiles(packed, i, height, width, points_uv, radii);
    for (int y = 0; y <= more.y; y++)
      for (int x = 0; x <= more.x; x++) entries[next[first_tile(packed) + y * tiles_x + x]++] = entry;
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
  const box_t inside = {
      larger_of(box.x0 - left, 0), larger_of(box.y0 - top, 0), smaller_of(box.x1 - left, TILE),
      smaller_of(box.y1 - top, TILE)};
  record.box = pack_box(inside, is_inside(box, firsts));
  return record;
}

#define DIGIT_BITS 8
#define DIGITS (1 << DIGIT_BITS)
#define DIGIT(key, low) ((int)((key) >> (low)) & (DIGITS - 1))
// Shorter lists are sorted by insertion only.
#define FEW 24

// Stable counting sort of a[0, n) by the two digits from bit `low` on, by way of scratch memory.
inline void sort_by_two_digits(global entry_t* a, global entry_t* scratch, int n, int low) {
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
  for (int i = 0; i < n; i++) scratch[first[DIGIT(a[i].key, low)]++] = a[i];
  for (int i = 0; i < n; i++) a[second[DIGIT(scratch[i].key, low + DIGIT_BITS)]++] = scratch[i];
}

// Stable sort of a[0, n) by key. The two highest digits that differ are sorted by counting, which leaves little for
// the insertion sort after them. Where it is not little (many depths that differ in the last digits only), counting
// goes on from the lowest digit: both are stable, so equal keys still are in the order of the index.
inline void sort_list(global entry_t* a, global entry_t* scratch, int n) {
  key_bits differing = 0;
  for (int i = 1; i < n; i++) differing |= a[i].key ^ a[0].key;
  if (differing == 0) return;
  const int high = REAL_BITS - (int)clz(differing);
  if (n > FEW) sort_by_two_digits(a, scratch, n, larger_of(high - 2 * DIGIT_BITS, 0));
  long moves_left = 8 * (long)n + FEW * FEW;
  for (int i = 1; i < n && moves_left > 0; i++) {
    const entry_t entry = a[i];
    int to = i;
    for (; to > 0 && a[to - 1].key > entry.key; to--) a[to] = a[to - 1];
    a[to] = entry;
    moves_left -= i - to;
  }
  if (moves_left <= 0)
    for (int low = 0; low < high; low += 2 * DIGIT_BITS) sort_by_two_digits(a, scratch, n, low);
}

// Sort the list of tile t, entries[0, n), into records; pixels of the quads of all footprints.
inline long sort_tile(
    int t, int n, int tiles_y, int tiles_x, int height, int width, int step_y, int step_x,
    global const REAL* restrict points_uv, global const REAL* restrict radii, global const REAL* restrict opacities,
    global entry_t* restrict entries, global entry_t* restrict scratch, global record_t* restrict records) {
  const int tiles = tiles_x * tiles_y, top = t % tiles / tiles_x * TILE, left = t % tiles_x * TILE;
  for (int i = 0; i < n; i++) {  // in the order of the index, close together; after the sort they are not
    const size_t id = entries[i].id;
    PREFETCH(points_uv + 2 * id);
    PREFETCH(radii + id);
    PREFETCH(opacities + id);
  }
  sort_list(entries, scratch, n);
  const box_t firsts = first_box(top / TILE, left / TILE, step_y, step_x);
  long size = 0;
  for (int i = 0; i < n; i++) {
    const record_t record = record_of(entries[i].id, top, left, height, width, firsts, points_uv, radii, opacities);
    records[i] = record;
    size += 4 * quads_in(unpack_box(record.box));
  }
  return size;
}
