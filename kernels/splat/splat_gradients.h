// What both mappings of the backward share: which gradients are computed, and those that need more than one tile.
//   HAS_BACKGROUNDS, HAS_GRAD_COVERAGE   0 or 1: whether these are given, or all 0
//   GRAD_FEATURES, GRAD_POINTS_UV, GRAD_RADII, GRAD_OPACITIES, GRAD_BACKGROUNDS   0 or 1
#ifdef GRAD_FEATURES
#if !defined(GRAD_POINTS_UV) || !defined(GRAD_RADII) || !defined(GRAD_OPACITIES) || !defined(GRAD_BACKGROUNDS)
#error "define all of GRAD_FEATURES, GRAD_POINTS_UV, GRAD_RADII, GRAD_OPACITIES and GRAD_BACKGROUNDS as 0 or 1"
#endif
#if !defined(HAS_BACKGROUNDS) || !defined(HAS_GRAD_COVERAGE)
#error "define HAS_BACKGROUNDS and HAS_GRAD_COVERAGE as 0 or 1"
#endif
#define GRAD_GEOMETRY (GRAD_POINTS_UV || GRAD_RADII || GRAD_OPACITIES)

// Numbers from one to the next in dL/dimage, whose memory is in any order; 0 where all are the same number.
typedef struct { long image, row, pixel, channel; } strides_t;

// Gradients of one point, summed over its fragments in this tile.
typedef struct { REAL u, v, r, o; } point_grads_t;

inline void write_scalars(
    point_grads_t grads, int id, bool first, global REAL* grad_points_uv, global REAL* grad_radii,
    global REAL* grad_opacities) {
#if GRAD_POINTS_UV
  global pair_t* grad_uv = (global pair_t*)(grad_points_uv + 2 * (size_t)id);
  *grad_uv = (first ? (REAL2)(0) : *grad_uv) + (REAL2)(grads.u, grads.v);
#endif
#if GRAD_RADII
  grad_radii[id] = (first ? (REAL)0 : grad_radii[id]) + grads.r;
#endif
#if GRAD_OPACITIES
  grad_opacities[id] = (first ? (REAL)0 : grad_opacities[id]) + grads.o;
#endif
}

// The gradients of points that are in no tile become 0.
inline void clear_unlisted(
    int begin, int end, global const int* restrict intersections, global REAL* restrict grad_features,
    global REAL* restrict grad_points_uv, global REAL* restrict grad_radii, global REAL* restrict grad_opacities) {
  const point_grads_t none = {0, 0, 0, 0};
  for (int i = begin; i < end; i++) {
    if (intersections[i] >= 0) continue;
#if GRAD_FEATURES
    clear_row(grad_features + (size_t)i * CHANNELS);
#endif
    write_scalars(none, i, true, grad_points_uv, grad_radii, grad_opacities);
  }
}

// One work-item a chunk of points.
kernel void clear_gradients(
    const int points,
    global const int* restrict intersections,  // [P], see splat_bin.cl
    global REAL* restrict grad_features, global REAL* restrict grad_points_uv, global REAL* restrict grad_radii,
    global REAL* restrict grad_opacities)
{
  const int c = get_global_id(0), chunks = get_global_size(0);
  const int begin = (long)points * c / chunks, end = (long)points * (c + 1) / chunks;
  clear_unlisted(begin, end, intersections, grad_features, grad_points_uv, grad_radii, grad_opacities);
}

// The gradient of a channel of an image's background: its tiles' gradients in order, with Kahan's compensation.
inline REAL sum_over_tiles(int b, int c, int tiles, global const REAL* tile_grad_backgrounds) {
  REAL sum = 0, lost = 0;
  for (int t = 0; t < tiles; t++) {
    const REAL next = tile_grad_backgrounds[((size_t)b * tiles + t) * CHANNELS + c] - lost;
    const REAL larger = sum + next;
    lost = (larger - sum) - next;
    sum = larger;
  }
  return sum;
}

// One work-item per channel of an image.
kernel void sum_grad_backgrounds(
    const int batch, const int tiles,
    global const REAL* restrict tile_grad_backgrounds,  // [B, tiles, C]
    global REAL* restrict grad_backgrounds)             // [B, C] out
{
  const int i = get_global_id(0), b = i / CHANNELS, c = i % CHANNELS;
  if (b >= batch) return;
  grad_backgrounds[i] = sum_over_tiles(b, c, tiles, tile_grad_backgrounds);
}
#endif
