// What compositing by tiles reads ahead, and how its backward traverses a list forward again. After tile.h, prefetch.h.
//
// Points read ahead of their turn.
#define AHEAD 16

// How many entries of a tile's list the backward has to traverse, and whether all their features are known to be
// finite.
inline int pack_traversed(int entries, bool finite) { return finite ? entries : ~entries; }
inline int entries_traversed(int packed) { return packed < 0 ? ~packed : packed; }
inline bool all_finite(int packed) { return packed >= 0; }

inline void read_ahead(global const record_t* records, int e, global const REAL* features) {
  global const REAL* row = features + (size_t)records[e].id * CHANNELS;
#pragma unroll
  for (int c = 0; c < CHANNELS; c += CACHE_LINE / sizeof(REAL)) PREFETCH(row + c);
}

#ifdef GRAD_FEATURES
inline void write_ahead(
    global const record_t* records, int e, global REAL* grad_features, global REAL* grad_points_uv,
    global REAL* grad_radii, global REAL* grad_opacities) {
  const size_t id = records[e].id;
#if GRAD_FEATURES
  if (!is_first(records[e].box)) {
    global REAL* row = grad_features + id * CHANNELS;
#pragma unroll
    for (int c = 0; c < CHANNELS; c += CACHE_LINE / sizeof(REAL)) PREFETCH_TO_WRITE(row + c);
  }
#endif
#if GRAD_POINTS_UV
  PREFETCH_TO_WRITE(grad_points_uv + 2 * id);
#endif
#if GRAD_RADII
  PREFETCH_TO_WRITE(grad_radii + id);
#endif
#if GRAD_OPACITIES
  PREFETCH_TO_WRITE(grad_opacities + id);
#endif
}

// The gradient at a tile's pixels, fetched item by item during the forward traversal, which does not need it yet.
// An item is a pixel where its channels are next to each other, else a row of pixels of PLANES channels.
#define PLANES ((CHANNELS + TILE - 1) / TILE)
#define PLANE_GROUPS ((CHANNELS + PLANES - 1) / PLANES)
typedef struct { global const REAL* corner; strides_t strides; int width; uint items, next; } gradient_ahead_t;

inline gradient_ahead_t gradient_ahead(tile_t tile, strides_t strides, global const REAL* corner) {
  gradient_ahead_t ahead = {corner, strides, tile.width, 0, 0};
  if (strides.channel == 1) ahead.items = tile.height * TILE;
  else if (strides.pixel == 1) ahead.items = tile.height * PLANE_GROUPS;
  return ahead;
}

inline void fetch_gradient(gradient_ahead_t* ahead) {
  if (ahead->next == ahead->items) return;
  const strides_t strides = ahead->strides;
  if (strides.channel == 1) {
    global const REAL* pixel = ahead->corner + ahead->next / TILE * strides.row + ahead->next % TILE * strides.pixel;
#pragma unroll
    for (int c = 0; c < CHANNELS; c += CACHE_LINE / sizeof(REAL)) PREFETCH_FAR(pixel + c);
  } else {
    const int first = ahead->next % PLANE_GROUPS * PLANES;
    global const REAL* row = ahead->corner + ahead->next / PLANE_GROUPS * strides.row + first * strides.channel;
    for (int c = 0; c < smaller_of(PLANES, CHANNELS - first); c++, row += strides.channel) {
      PREFETCH_FAR(row);
      PREFETCH_FAR(row + ahead->width - 1);
    }
  }
  ahead->next++;
}

#ifndef SEGMENT
#error "define SEGMENT, the fragments that the backward keeps at a time"
#endif
#if SEGMENT < TILE * TILE
#error "SEGMENT must be at least TILE * TILE, a point's largest footprint: no segment would hold it"
#endif

// What the backward keeps of one segment, quad by quad, and of the tile's pixels.
typedef struct { REAL4 alpha, before; } quad_t;  // a_i and T_i, 0 and 0 where there is no fragment
typedef struct {
  quad_t quads[SEGMENT / 4];
  REAL transmittance[PADDED];
} traversal_t;

// Traverse forward from entry e until the segment is full or the list ends; returns the entry after the last.
inline int traverse_forward(
    traversal_t* traversal, int e, int end, bool known_finite, tile_t tile, REAL min_transmittance,
    global const record_t* records, global const REAL* features, gradient_ahead_t* ahead) {
  for (int offset = 0; e < end; e++) {
    fetch_gradient(ahead);
    global const record_t* point = records + e;
    const box_t box = unpack_box(point->box);
    if (offset + quads_in(box) > SEGMENT / 4) break;
    bool finite = true;
    if (!known_finite) {
      vector_t f[BLOCKS];
      finite = load_row(features + (size_t)point->id * CHANNELS, f);
    }
    disc_t disc = disc_of(point, tile);
    if (!finite) disc.r2 = 0;
    for (int y = box.y0; y < box.y1; y += 2)
      for (int x = box.x0; x < box.x1; x += 2, offset++) {
        const int p = y * STRIDE + x;
        const REAL4 t = load_quad(traversal->transmittance, p);
        quad_t quad;
        quad.alpha = quad_alphas(disc, x, y, t, min_transmittance, &quad.before);
        traversal->quads[offset] = quad;
        store_quad(t * (1 - quad.alpha), traversal->transmittance, p);
      }
  }
  return e;
}
#endif
