// Geometry that binning and compositing share. A point's fragments lie in its footprint: the pixels whose
// centres (x + 0.5, y + 0.5) are nearer to (u, v) than r.
//   TILE   side of a square tile, pixels
#ifndef TILE
#error "define TILE, the side of a tile in pixels"
#endif
#define PIXELS (TILE * TILE)

// Slack of the footprint, pixels: u - r is rounded, and the test d2 < r2 decides anyway. It covers float32
// coordinates up to 2^13 px.
#define SLACK ((REAL)(1.0 / 512))

// Pixels [x0, x1) x [y0, y1); empty where x0 >= x1 or y0 >= y1.
typedef struct { int x0, y0, x1, y1; } box_t;

// One entry of a tile list while it is sorted: the bits of z (positive, so they order as z does) and the point.
typedef struct { key_t_ key, id; } entry_t;

// One entry of a sorted tile list. box: the footprint inside the tile, x0 | x1 << 8 | y0 << 16 | y1 << 24.
typedef struct { REAL u, v, r, r2, slope, o; int box, id; } record_t;

inline int first_pixel(REAL low, int size) {
  low = low - (REAL)0.5 - SLACK;
  low = low > 0 ? low : 0;
  low = low < size ? low : size;
  const int whole = (int)low;
  return whole + (low > whole);
}

inline int last_pixel(REAL high, int size) {
  high = high + (REAL)0.5 + SLACK;
  high = high > 0 ? high : 0;
  high = high < size ? high : size;
  return (int)high;
}

inline box_t footprint(REAL u, REAL v, REAL r, int height, int width) {
  box_t box;
  box.x0 = first_pixel(u - r, width);
  box.x1 = last_pixel(u + r, width);
  box.y0 = first_pixel(v - r, height);
  box.y1 = last_pixel(v + r, height);
  return box;
}

// Whether a point can make fragments: all its numbers finite, not behind the near plane, some radius.
inline bool drawable(REAL u, REAL v, REAL z, REAL r, REAL o) {
  return (u * 0 + v * 0 + z * 0 + r * 0 + o * 0 == 0) & (z >= (REAL)NEAR) & (r > 0);
}
