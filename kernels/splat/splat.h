// Geometry and vectors that the splat kernels share. A point's fragments lie in its footprint: the pixels whose
// centres (x + 0.5, y + 0.5) are nearer to (u, v) than r.
//   TILE                        side of a square tile, pixels
//   ENTRY_BYTES, RECORD_BYTES   the host's sizes of entry_t and record_t
#ifndef TILE
#error "define TILE, the side of a tile in pixels"
#endif
#if TILE > 31
#error "TILE must be below 32: pack_box has 5 bits for each side of a box"
#endif
#if !defined(ENTRY_BYTES) || !defined(RECORD_BYTES)
#error "define ENTRY_BYTES and RECORD_BYTES, the host's sizes of entry_t and record_t"
#endif
#define PIXELS (TILE * TILE)

// Drivers may leave OpenCL's own functions as calls: PoCL does where its library was built for another CPU. A call in
// a loop keeps that loop from becoming vector code, and all vectors are saved around it. These are always inlined.
inline int smaller_of(int a, int b) { return a < b ? a : b; }
inline int larger_of(int a, int b) { return a > b ? a : b; }
typedef REAL2 __attribute__((aligned(REAL_BITS / 8))) pair_t;  // two numbers next to each other

// Slack of the footprint, pixels: u - r is rounded, and the test d2 < r2 decides anyway. It covers float32
// coordinates up to 2^13 px.
#define SLACK ((REAL)(1.0 / 512))

// Pixels [x0, x1) x [y0, y1); empty where x0 >= x1 or y0 >= y1.
typedef struct { int x0, y0, x1, y1; } box_t;

// One entry of a tile list while it is sorted: the bits of z (positive, so they order as z does) and the point.
typedef struct { key_bits key, id; } entry_t;

// One entry of a sorted tile list. box holds the footprint inside the tile, see pack_box.
typedef struct { REAL u, v, r, o; int box, id; } record_t;

ASSERT_SIZE(entry_t, ENTRY_BYTES);
ASSERT_SIZE(record_t, RECORD_BYTES);

// A footprint inside one tile, and whether the tile is the first of the point's to be traversed backward, see
// first_box.
inline int pack_box(box_t box, bool first) {
  return box.x0 | box.x1 << 5 | box.y0 << 10 | box.y1 << 15 | (int)first << 20;
}
inline box_t unpack_box(int packed) {
  const box_t box = {packed & 31, packed >> 10 & 31, packed >> 5 & 31, packed >> 15 & 31};
  return box;
}
inline bool is_first(int packed) { return packed >> 20 & 1; }

// The indices of the pixels in [0, size) whose centres lie in (low, high) are [first_pixel(low), end_pixel(high)).
inline int first_pixel(REAL low, int size) {
  low -= (REAL)0.5 + SLACK;
  low = low > 0 ? low : 0;
  low = low < size ? low : size;
  const int whole = (int)low;
  return whole + (low > whole);
}

inline int end_pixel(REAL high, int size) {
  high += (REAL)0.5 + SLACK;
  high = high > 0 ? high : 0;
  high = high < size ? high : size;
  return (int)high;
}

inline box_t footprint(REAL u, REAL v, REAL r, int height, int width) {
  const box_t box = {
      first_pixel(u - r, width), first_pixel(v - r, height), end_pixel(u + r, width), end_pixel(v + r, height)};
  return box;
}

// The backward takes the columns (and the rows) of tiles 0, step, 2 step, ..., then 1, step + 1, ..., and so on, and no
// footprint covers more than `step`. So a column is the first that it takes of a footprint if it is one of the first
// kind, or if the footprint begins in it and ends before the next of the first kind: if it lies in [x, y).
inline int2 first_range(int column, int step) {
  const int after = column % step;
  return after == 0 ? (int2)(0, INT_MAX) : (int2)(column * TILE, (column - after + step) * TILE);
}

// The tile in that row and column is the first that the backward takes of the points whose footprint lies in this box.
inline box_t first_box(int row, int column, int step_y, int step_x) {
  const int2 x = first_range(column, step_x), y = first_range(row, step_y);
  const box_t box = {x.x, y.x, x.y, y.y};
  return box;
}

inline bool is_inside(box_t inner, box_t outer) {
  return (inner.x0 >= outer.x0) & (inner.y0 >= outer.y0) & (inner.x1 <= outer.x1) & (inner.y1 <= outer.y1);
}

inline bool is_empty(box_t box) { return (box.x0 >= box.x1) | (box.y0 >= box.y1); }

inline int area_of(box_t box) { return (box.x1 - box.x0) * (box.y1 - box.y0); }

// Quads (2 x 2 pixels) that cover a footprint, from its first pixel on.
inline int quads_in(box_t box) { return ((box.x1 - box.x0 + 1) >> 1) * ((box.y1 - box.y0 + 1) >> 1); }

// Whether a point can make fragments: all its numbers finite, not in front of the near plane, some radius. Where r^2
// is no normal number (r below 1e-19 px or above 1e19 px in float32) the formula has no meaning.
inline bool drawable(REAL u, REAL v, REAL z, REAL r, REAL o) {
  const REAL r2 = r * r;
  return (u * 0 + v * 0 + z * 0 + r2 * 0 + o * 0 == 0) & (z >= (REAL)NEAR) & (r > 0) & (r2 >= SMALLEST);
}

// A point's tile intersections in one number: its first tile, and how many more rows and columns of tiles it covers.
// -1: in no list. MANY means MANY or more; the footprint then gives the number.
#define MORE_BITS 2
#define MANY ((1 << MORE_BITS) - 1)
inline int pack_intersections(int tile, int more_rows, int more_columns) {
  return tile << 2 * MORE_BITS | smaller_of(more_rows, MANY) << MORE_BITS | smaller_of(more_columns, MANY);
}
inline int first_tile(int packed) { return packed >> 2 * MORE_BITS; }
inline bool is_in_one_tile(int packed) { return (packed & ((1 << 2 * MORE_BITS) - 1)) == 0; }
