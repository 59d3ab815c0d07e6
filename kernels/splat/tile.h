// Traversal of one tile by a work-item: in quads of 2 x 2 pixels, the lanes of a vector of four. After channels.h.
//   TRUNCATE   1: a pixel takes no more fragments once T < min_transmittance; 0: it takes all
#ifndef TRUNCATE
#error "define TRUNCATE as 0 or 1"
#endif
#if TRUNCATE
#define EXISTS(d2, r2, t) (((d2) < (r2)) & ((t) >= min_transmittance))
#else
#define EXISTS(d2, r2, t) ((d2) < (r2))
#endif

// A footprint is traversed in quads: pixels p, p + 1, p + STRIDE, p + STRIDE + 1. A quad may reach one pixel beyond its
// footprint (where alpha is 0) and beyond the tile, into an apron that is never shown and has no gradient.
#define STRIDE (TILE + 1)
#define PADDED (STRIDE * STRIDE)

typedef struct { int b, left, top, width, height; } tile_t;

inline tile_t tile_at(int t, int height, int width, int tiles_y, int tiles_x) {
  tile_t tile;
  tile.b = t / (tiles_y * tiles_x);
  tile.left = t % tiles_x * TILE;
  tile.top = t / tiles_x % tiles_y * TILE;
  tile.width = smaller_of(TILE, width - tile.left);
  tile.height = smaller_of(TILE, height - tile.top);
  return tile;
}

// Whether no pixel of the tile can change any more.
inline bool is_opaque(const REAL* transmittance, tile_t tile, REAL min_transmittance) {
  int open = 0;
  for (int y = 0; y < tile.height; y++)
    for (int x = 0; x < tile.width; x++) {
      const REAL t = transmittance[y * STRIDE + x];
      open += EXISTS(0, 1, t) & (t != 0);
    }
  return open == 0;
}

// What a quad's alphas need of a point, relative to the tile.
typedef struct { REAL4 u, v; REAL r2, slope, o; } disc_t;

inline disc_t disc_of(global const record_t* point, tile_t tile) {
  const REAL r2 = point->r * point->r;
  const disc_t disc = {
      point->u - tile.left - (REAL)0.5 - (REAL4)(0, 1, 0, 1), point->v - tile.top - (REAL)0.5 - (REAL4)(0, 0, 1, 1),
      r2, point->o / r2, point->o};
  return disc;
}

inline REAL4 load_quad(const REAL* pixels, int p) {
  return (REAL4)(*(const pair_t*)(pixels + p), *(const pair_t*)(pixels + p + STRIDE));
}

inline void store_quad(REAL4 quad, REAL* pixels, int p) {
  *(pair_t*)(pixels + p) = quad.lo;
  *(pair_t*)(pixels + p + STRIDE) = quad.hi;
}

// Alphas of the quad at (x, y), and in *before the transmittances t: both 0 where there is no fragment.
inline REAL4 quad_alphas(disc_t disc, int x, int y, REAL4 t, REAL min_transmittance, REAL4* before) {
  const REAL4 dx = x - disc.u, dy = y - disc.v, d2 = dx * dx + dy * dy;
  *before = EXISTS(d2, disc.r2, t) ? t : (REAL4)0;
  return EXISTS(d2, disc.r2, t) ? disc.o - disc.slope * d2 : (REAL4)0;
}

#ifdef GRAD_FEATURES
// VECTOR numbers of one channel along a row of pixels, of which `count` exist; the others are undefined.
inline vector_t load_line(global const REAL* line, long pixel_stride, int count) {
  if (pixel_stride == 0) return *line;
  if (pixel_stride == 1 && count >= VECTOR) return *(global const loose_vector_t*)line;
  vector_t numbers = 0;
  for (int x = 0; x < smaller_of(count, VECTOR); x++) ((REAL*)&numbers)[x] = line[x * pixel_stride];
  return numbers;
}

// Block k of the gradients at VECTOR pixels of a row, of which `count` are in the image, from channels that are not
// next to each other: a line of pixels for each channel, transposed.
inline void load_grad_lines(
    vector_t grads[PADDED][BLOCKS], int k, int count, strides_t strides, global const REAL* pixel) {
  vector_t lines[VECTOR];
#pragma unroll
  for (int lane = 0; lane < VECTOR; lane++) {
    const bool again = k == BLOCKS - 1 && lane < OVERLAP;
    global const REAL* line = pixel + (BLOCK_START(k) + lane) * strides.channel;
    lines[lane] = again ? (vector_t)0 : load_line(line, strides.pixel, count);
  }
  transpose(lines);
  if (count >= VECTOR)
#pragma unroll
    for (int x = 0; x < VECTOR; x++) grads[x][k] = lines[x];
  else
    for (int x = 0; x < count; x++) grads[x][k] = lines[x];
}

// The gradients at the tile's pixels, 0 outside the image and in the apron. Lanes that overlap are 0, to count once
// in a dot product.
inline void load_grad_image(vector_t grads[PADDED][BLOCKS], tile_t tile, strides_t strides, global const REAL* corner) {
  for (int y = 0; y < STRIDE; y++)
    for (int x = y < tile.height ? tile.width : 0; x < STRIDE; x++)
#pragma unroll
      for (int k = 0; k < BLOCKS; k++) grads[y * STRIDE + x][k] = 0;
  for (int y = 0; y < tile.height; y++) {
    global const REAL* row = corner + y * strides.row;
    if (strides.channel == 1)
      for (int x = 0; x < tile.width; x++) {
        copy_row(row + x * strides.pixel, grads[y * STRIDE + x]);
        for (int lane = 0; lane < OVERLAP; lane++) ((REAL*)&grads[y * STRIDE + x][BLOCKS - 1])[lane] = 0;
      }
    else
      for (int k = 0; k < BLOCKS; k++)
        for (int x = 0; x < tile.width; x += VECTOR)
          load_grad_lines(grads + y * STRIDE + x, k, tile.width - x, strides, row + x * strides.pixel);
  }
}
#endif
