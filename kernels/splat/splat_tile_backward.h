// The backward of compositing in one tile, for splat_composite.cl. After splat_traversal.h.
#ifdef GRAD_FEATURES
// What lies behind the last fragment of every pixel: A_end = b.g - h.
inline void look_behind(
    const vector_t g[PADDED][BLOCKS], tile_t tile, int height, int width, global const REAL* background_row,
    global const REAL* grad_coverage, REAL* behind) {
  for (int p = 0; p < PADDED; p++) behind[p] = 0;
#if HAS_BACKGROUNDS
  vector_t background[BLOCKS];
  copy_row(background_row, background);
  for (int p = 0; p < PADDED; p++) {
    vector_t products = 0;
#pragma unroll
    for (int k = 0; k < BLOCKS; k++) products += background[k] * g[p][k];
    behind[p] = sum_lanes(products);
  }
#endif
#if HAS_GRAD_COVERAGE
  for (int y = 0; y < tile.height; y++) {
    global const REAL* row = grad_coverage + ((size_t)tile.b * height + tile.top + y) * width + tile.left;
    for (int x = 0; x < tile.width; x++) behind[y * STRIDE + x] -= row[x];
  }
#endif
}

// The tile's share of the background's gradient: T_end g summed over each row of pixels, then over the rows.
inline void sum_background(
    const vector_t g[PADDED][BLOCKS], const REAL* transmittance, tile_t tile, global REAL* grad_row) {
  vector_t total[BLOCKS];
  for (int k = 0; k < BLOCKS; k++) total[k] = 0;
  for (int y = 0; y < tile.height; y++) {
    vector_t sum[BLOCKS];
    for (int k = 0; k < BLOCKS; k++) sum[k] = 0;
    for (int x = 0; x < tile.width; x++)
      for (int k = 0; k < BLOCKS; k++) sum[k] += transmittance[y * STRIDE + x] * g[y * STRIDE + x][k];
    for (int k = 0; k < BLOCKS; k++) total[k] += sum[k];
  }
  store_row(total, grad_row);
}

// Entries [e, end) make no fragments here, for all pixels stopped before them: they have no gradient.
inline void clear_hidden(
    global const record_t* records, int e, int end, global REAL* grad_features, global REAL* grad_points_uv,
    global REAL* grad_radii, global REAL* grad_opacities) {
  const point_grads_t none = {0, 0, 0, 0};
  for (; e < end; e++) {
    if (!is_first(records[e].box)) continue;
    const size_t id = records[e].id;
#if GRAD_FEATURES
    clear_row(grad_features + id * CHANNELS);
#endif
    write_scalars(none, id, true, grad_points_uv, grad_radii, grad_opacities);
  }
}

// Traverse a segment's entries back to front, writing or adding to their points' gradients.
inline void traverse_back(
    const traversal_t* traversal, const vector_t g[PADDED][BLOCKS], REAL* behind, int first, int stop,
    bool known_finite, tile_t tile, global const record_t* records, global const REAL* features,
    global REAL* grad_features, global REAL* grad_points_uv, global REAL* grad_radii, global REAL* grad_opacities) {
  int offset = 0;
  for (int e = first; e < stop; e++) offset += quads_in(unpack_box(records[e].box));
  for (int e = stop - 1; e >= first; e--) {
    const int next = larger_of(e - AHEAD, first);
    read_ahead(records, next, features);
    write_ahead(records, next, grad_features, grad_points_uv, grad_radii, grad_opacities);
    global const record_t* point = records + e;
    const int id = point->id;
    const box_t box = unpack_box(point->box);
    const disc_t disc = disc_of(point, tile);
    vector_t f[BLOCKS], grad_f[BLOCKS];
    bool finite = true;
    if (known_finite) copy_row(features + (size_t)id * CHANNELS, f);
    else finite = load_row(features + (size_t)id * CHANNELS, f);
#pragma unroll
    for (int k = 0; k < BLOCKS; k++) {
      grad_f[k] = 0;
      if (!finite) f[k] = 0;
    }
    offset -= quads_in(box);
    const quad_t* quad = traversal->quads + offset;
    REAL4 sum_da = 0, sum_dx = 0, sum_dy = 0, sum_d2 = 0;
    for (int y = box.y0; y < box.y1; y += 2)
      for (int x = box.x0; x < box.x1; x += 2, quad++) {
        const int p = y * STRIDE + x;
        const REAL4 a = quad->alpha, t = quad->before, w = a * t;
#if GRAD_GEOMETRY
        vector_t products[4] = {0, 0, 0, 0};
#pragma unroll
        for (int k = 0; k < BLOCKS; k++) {
          products[0] += f[k] * g[p][k];
          products[1] += f[k] * g[p + 1][k];
          products[2] += f[k] * g[p + STRIDE][k];
          products[3] += f[k] * g[p + STRIDE + 1][k];
        }
        const REAL4 fg = sum_lanes_of_four(products), after = load_quad(behind, p);
        const REAL4 da = t * (fg - after);
        store_quad(a * fg + (1 - a) * after, behind, p);
        const REAL4 dx = x - disc.u, dy = y - disc.v;
        sum_da += da;
        sum_dx += da * dx;
        sum_dy += da * dy;
        sum_d2 += da * (dx * dx + dy * dy);
#endif
#if GRAD_FEATURES
#pragma unroll
        for (int k = 0; k < BLOCKS; k++)
          grad_f[k] += w.x * g[p][k] + w.y * g[p + 1][k] + w.z * g[p + STRIDE][k] + w.w * g[p + STRIDE + 1][k];
#endif
      }
    const bool first_tile = is_first(point->box);
#if GRAD_FEATURES
    global REAL* row = grad_features + (size_t)id * CHANNELS;
    if (first_tile) stream_row(grad_f, row);
    else add_row(grad_f, row);
#endif
#if GRAD_GEOMETRY
    const REAL slope = 2 * disc.slope, d2 = sum_of_four(sum_d2);
    const point_grads_t grads = {
        slope * sum_of_four(sum_dx), slope * sum_of_four(sum_dy), slope * d2 / point->r,
        sum_of_four(sum_da) - d2 / disc.r2};
    write_scalars(grads, id, first_tile, grad_points_uv, grad_radii, grad_opacities);
#endif
  }
}

// The gradients of a tile's points, and its share of the background's. Arguments are those of the kernels.
inline void composite_tile_backward(
    int index, int height, int width, int tiles_y, int tiles_x, REAL min_transmittance, strides_t strides,
    global const int* restrict tile_starts, global const record_t* restrict records,
    global const REAL* restrict features, global const REAL* restrict backgrounds,
    global const int* restrict tile_traversed, global const REAL* restrict grad_image,
    global const REAL* restrict grad_coverage, global const int* restrict checkpoint_starts,
    global REAL* restrict checkpoints, global int* restrict checkpoint_entries, global REAL* restrict grad_features,
    global REAL* restrict grad_points_uv, global REAL* restrict grad_radii, global REAL* restrict grad_opacities,
    global REAL* restrict tile_grad_backgrounds) {
  const tile_t tile = tile_at(index, height, width, tiles_y, tiles_x);
  const int begin = tile_starts[index], end = begin + entries_traversed(tile_traversed[index]);
  const bool finite = all_finite(tile_traversed[index]);
  clear_hidden(records, end, tile_starts[index + 1], grad_features, grad_points_uv, grad_radii, grad_opacities);
#if !GRAD_BACKGROUNDS
  if (begin == end) return;
#endif

  // Forward, keeping the first transmittances of every segment but the first.
  global const REAL* corner =
      grad_image + tile.b * strides.image + tile.top * strides.row + tile.left * strides.pixel;
  gradient_ahead_t ahead = gradient_ahead(tile, strides, corner);
  traversal_t traversal;
  for (int p = 0; p < PADDED; p++) traversal.transmittance[p] = 1;
  int segment = 0, first = begin;
  int stop = traverse_forward(&traversal, begin, end, finite, tile, min_transmittance, records, features, &ahead);
  while (stop < end) {
    const int at = checkpoint_starts[index] + ++segment;
    checkpoint_entries[at] = first = stop;
    for (int p = 0; p < PADDED; p++) checkpoints[(size_t)at * PADDED + p] = traversal.transmittance[p];
    stop = traverse_forward(&traversal, first, end, finite, tile, min_transmittance, records, features, &ahead);
  }

  for (int e = larger_of(stop - AHEAD, first); e < stop; e++) read_ahead(records, e, features);
  vector_t g[PADDED][BLOCKS];
  load_grad_image(g, tile, strides, corner);
#if GRAD_BACKGROUNDS
  sum_background(g, traversal.transmittance, tile, tile_grad_backgrounds + (size_t)index * CHANNELS);
#endif

  // Backward, segment by segment.
  REAL behind[PADDED];
  look_behind(g, tile, height, width, backgrounds + (size_t)tile.b * CHANNELS, grad_coverage, behind);
  for (;;) {
    traverse_back(
        &traversal, g, behind, first, stop, finite, tile, records, features, grad_features, grad_points_uv, grad_radii,
        grad_opacities);
    if (segment == 0) break;
    const int at = checkpoint_starts[index] + --segment;
    first = segment == 0 ? begin : checkpoint_entries[at];
    for (int p = 0; p < PADDED; p++)
      traversal.transmittance[p] = segment == 0 ? (REAL)1 : checkpoints[(size_t)at * PADDED + p];
    stop = traverse_forward(&traversal, first, end, finite, tile, min_transmittance, records, features, &ahead);
  }
}
#endif
