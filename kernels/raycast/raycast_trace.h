// The nearest hit of a row of rays from the camera, LANES at a time.

enum { SKY = -2, ROAD = -1 };

typedef struct {
  float x[LANES], y[LANES], z[LANES];  // each ray's direction, of z-depth 1
  float best[LANES];                   // z-depth of its nearest hit
  int hit[LANES];                      // the solid it hits, ROAD or SKY
} row_t;

// Where the leaves are in front of what was hit so far: the shell's near side, else its far side seen through a gap.
static void hit_foliage(global const solid_t* solid, int id, float16 enter, float16 exit, row_t* row)
{
  float near[LANES], far[LANES];
  vstore16(enter, 0, near);
  vstore16(exit, 0, far);
  for (int lane = 0; lane < LANES; lane++) {
    if (!(near[lane] < far[lane] && near[lane] > (float)NEAR && near[lane] < row->best[lane])) continue;
    const float3 ray = (float3)(row->x[lane], row->y[lane], row->z[lane]), from = -load3(solid->centre);
    float s = near[lane];
    if (is_gap(solid, to_local(solid, from + s * ray))) {
      s = far[lane];
      if (s >= row->best[lane] || is_gap(solid, to_local(solid, from + s * ray))) continue;
    }
    row->best[lane] = s;
    row->hit[lane] = id;
  }
}

// Rays through row y of the image, `left` the first and the others a pixel's width further right each, against the
// road and the `count` solids of `listed`.
static void trace(
    const scene_t* scene, global const ushort* listed, int count, global const int4* image_rects, int y, float3 left,
    row_t* row)
{
  global const view_t* view = scene->view;
  const float16 step = (float16)(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
  const float16 dx = left.x + step * view->ray[0], dy = left.y + step * view->ray[3], dz = left.z + step * view->ray[6];
  vstore16(dx, 0, row->x);
  vstore16(dy, 0, row->y);
  vstore16(dz, 0, row->z);
  const float16 road = -view->camera[1] / dy;
  const int16 on_road = road > (float)NEAR && road < (float)SKY_DEPTH;
  vstore16(select((float16)(SKY_DEPTH), road, on_road), 0, row->best);
  vstore16(select((int16)(SKY), (int16)(ROAD), on_road), 0, row->hit);
  for (int k = 0; k < count; k++) {
    const int i = listed[k];
    if (y < image_rects[i].y || y >= image_rects[i].w) continue;
    global const solid_t* solid = scene->solids + i;
    float16 enter, exit;
    interval_float16(solid, (float3)(0), dx, dy, dz, &enter, &exit);
    if (solid->material == MATERIAL_FOLIAGE) {
      hit_foliage(solid, i, enter, exit, row);
    } else {
      const float16 nearest = vload16(0, row->best);
      const int16 nearer = enter < exit && enter > (float)NEAR && enter < nearest;
      vstore16(select(nearest, enter, nearer), 0, row->best);
      vstore16(select(vload16(0, row->hit), (int16)(i), nearer), 0, row->hit);
    }
  }
}
