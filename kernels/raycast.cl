// The procedural street, seen by a pinhole camera. A pixel's ray is s (R K^-1) (u, v, 1), scaled so that s is its
// z-depth; the nearest of the road plane and all solids gives depth and label, and its surface is shaded.
//   project_solids  one work-item a solid: its rectangle on the image, and where its shadow falls on the road
//   list_solids     one work-item a row of cells (image tiles, or squares of road): which rectangles touch each cell
//   raycast         one work-item LANES pixels of a row: intersects its tile's solids LANES pixels at a time, then
//                   shades pixel by pixel, with a shadow ray through the solids of one square of road
#include "common.h"
#include "raycast_types.h"
#include "raycast_noise.h"
#define FLOATS float
#include "raycast_interval.h"
#undef FLOATS
#define FLOATS float16
#include "raycast_interval.h"
#include "raycast_town.h"
#include "raycast_things.h"
#include "raycast_light.h"

#define EDGE 0.09f  // how far from a car's edges its normal bends, metres

#if TILE != LANES
#error "a row of a tile must be LANES pixels"
#endif

static float3 corner(global const solid_t* s, int i)
{
  const float3 sign = (float3)(i & 1 ? 1 : -1, i & 2 ? 1 : -1, i & 4 ? 1 : -1);
  return load3(s->centre) + to_world(s, sign * load3(s->half_size));
}

static float3 multiply(global const float* m, float3 a)
{
  return (float3)(dot(load3(m), a), dot(load3(m + 3), a), dot(load3(m + 6), a));
}

// The rectangle [x, y, z, w) of the image that the solid's bounding box covers, its edges clipped at z = NEAR.
static int4 image_rect(global const view_t* view, global const solid_t* s, int height, int width)
{
  float2 low = INFINITY, high = -INFINITY;
  for (int edge = 0; edge < 24; edge++) {
    const int bit = 1 << edge / 8, i = edge % 8;
    if (i & bit) continue;
    float3 a = multiply(view->project, corner(s, i)), b = multiply(view->project, corner(s, i | bit));
    const float near = NEAR;
    if (a.z < near && b.z < near) continue;
    const float3 step = (b - a) * ((near - a.z) / (b.z - a.z));
    if (b.z < near) b = a + step;
    else if (a.z < near) a = a + step;
    const float2 p = a.xy / a.z, q = b.xy / b.z;
    low = min(low, min(p, q));
    high = max(high, max(p, q));
  }
  const float2 size = (float2)(width, height);
  const int2 first = convert_int2(clamp(floor(low - 1), (float2)(0), size));
  const int2 last = convert_int2(clamp(ceil(high + 1), (float2)(0), size));
  return (int4)(first, last);
}

// The rectangle [x, z, x, z] of road where the solid's shadow or its daylight shade can fall, metres from the camera.
static float4 shadow_rect(global const view_t* view, global const solid_t* s)
{
  const float3 sun = load3(view->sun);
  float2 low = INFINITY, high = -INFINITY;
  for (int i = 0; i < 8; i++) {
    const float3 p = corner(s, i);
    const float2 fallen = p.xz + sun.xz * ((-view->camera[1] - p.y) / sun.y);
    low = min(low, fallen);
    high = max(high, fallen);
  }
  const float margin = s->material == MATERIAL_CAR_BODY ? 0.8f : 0.05f;
  return (float4)(low - margin, high + margin);
}

// The cells of the shadow grid that it touches; a pavement's own shadow is too low to count.
static int4 cells_of(global const view_t* view, global const solid_t* s, float4 rect, int rows, int columns)
{
  const float2 origin = (float2)(view->grid[0], view->grid[1]), size = (float2)(columns, rows);
  const int2 first = convert_int2(clamp(floor((rect.lo - origin) / SHADOW_CELL), (float2)(0), size));
  const int2 last = convert_int2(clamp(ceil((rect.hi - origin) / SHADOW_CELL), (float2)(0), size));
  return s->material == MATERIAL_PAVEMENT ? (int4)(0) : (int4)(first, last);
}

kernel void project_solids(
    const int height, const int width, const int cell_rows, const int cell_columns,
    global const view_t* restrict view,      // [1]
    global const solid_t* restrict solids,   // [P]
    global int4* restrict image_rects,       // [P] out, pixels
    global int4* restrict shadow_cells,      // [P] out
    global float4* restrict shadow_rects)    // [P] out, metres
{
  const int i = get_global_id(0);
  image_rects[i] = image_rect(view, solids + i, height, width);
  shadow_rects[i] = shadow_rect(view, solids + i);
  shadow_cells[i] = cells_of(view, solids + i, shadow_rects[i], cell_rows, cell_columns);
}

kernel void list_solids(
    const int columns, const int cell, const int solid_count,
    global const int4* restrict rects,       // [P], in units of 1 / cell
    global ushort* restrict cell_solids,     // [rows * columns, P] out, in ascending order
    global int* restrict cell_counts)        // [rows * columns] out
{
  const int row = get_global_id(0);
  global int* counts = cell_counts + row * columns;
  for (int c = 0; c < columns; c++) counts[c] = 0;
  for (int i = 0; i < solid_count; i++) {
    const int4 r = rects[i];
    if (r.x >= r.z || r.y >= (row + 1) * cell || r.w <= row * cell) continue;
    for (int c = r.x / cell; c <= (r.z - 1) / cell; c++)
      cell_solids[((size_t)row * columns + c) * solid_count + counts[c]++] = i;
  }
}

// Where the leaves are in front of what was hit so far: the shell's near side, else its far side seen through a gap.
static void hit_foliage(
    global const solid_t* solid, int id, const float* dx, const float* dy, const float* dz, float16 enter, float16 exit,
    float* best, int* hit)
{
  float near[LANES], far[LANES];
  vstore16(enter, 0, near);
  vstore16(exit, 0, far);
  for (int lane = 0; lane < LANES; lane++) {
    if (!(near[lane] < far[lane] && near[lane] > (float)NEAR && near[lane] < best[lane])) continue;
    const float3 ray = (float3)(dx[lane], dy[lane], dz[lane]), from = -load3(solid->centre);
    float s = near[lane];
    if (is_gap(solid, to_local(solid, from + s * ray))) {
      s = far[lane];
      if (s >= best[lane] || is_gap(solid, to_local(solid, from + s * ray))) continue;
    }
    best[lane] = s;
    hit[lane] = id;
  }
}

// The face of a box that a point of its surface is on, and how far outside each face's plane it is (zero or negative).
static int face_of(global const solid_t* s, float3 unit, float* out)
{
  const float rise = 0.5f * (1 - unit.y);
  out[FACE_RIGHT] = unit.x - 1 + rise * s->taper[0];
  out[FACE_LEFT] = -unit.x - 1 + rise * s->taper[0];
  out[FACE_FRONT] = unit.z - 1 + rise * s->taper[1];
  out[FACE_BACK] = -unit.z - 1 + rise * s->taper[2];
  out[FACE_TOP] = -unit.y - 1;
  out[FACE_BOTTOM] = unit.y - 1;
  int face = 0;
  for (int i = 1; i < 6; i++)
    if (out[i] > out[face]) face = i;
  return face;
}

// Outward unit normal in the solid's own axes.
static float3 face_normal(global const solid_t* s, int face)
{
  const float side = -0.5f * s->taper[0], front = -0.5f * s->taper[1], back = -0.5f * s->taper[2];
  const float3 scale = 1 / load3(s->half_size);
  switch (face) {
    case FACE_RIGHT: return normalize(scale * (float3)(1, side, 0));
    case FACE_LEFT: return normalize(scale * (float3)(-1, side, 0));
    case FACE_FRONT: return normalize(scale * (float3)(0, front, 1));
    case FACE_BACK: return normalize(scale * (float3)(0, back, -1));
    case FACE_TOP: return (float3)(0, -1, 0);
    default: return (float3)(0, 1, 0);
  }
}

// A car's edges look round: near them its normal turns from face to face.
static float3 bent_normal(global const solid_t* s, const float* out)
{
  const float3 reach = load3(s->half_size);
  const float size[6] = {reach.x, reach.x, reach.z, reach.z, reach.y, reach.y};
  float3 sum = 0;
  for (int i = 0; i < 6; i++) {
    const float weight = 1 + out[i] * size[i] / EDGE;
    if (weight > 0) sum += weight * weight * face_normal(s, i);
  }
  return normalize(sum);
}

static bool is_car(int material)
{
  return material == MATERIAL_CAR_BODY || material == MATERIAL_CAR_PANEL || material == MATERIAL_CAR_CABIN;
}

// Face and normal of the solid at the point of its surface that hit->own holds.
static void orient(global const solid_t* s, hit_t* hit)
{
  const float3 reach = load3(s->half_size), unit = hit->own / reach;
  float3 normal = unit / reach;
  if (s->shape == SHAPE_CYLINDER) normal = fabs(unit.y) > 0.999f ? (float3)(0, unit.y, 0) : (float3)(unit.x, 0, unit.z);
  if (s->shape == SHAPE_BOX) {
    float out[6];
    hit->face = face_of(s, unit, out);
    normal = is_car(s->material) ? bent_normal(s, out) : face_normal(s, hit->face);
  }
  hit->normal = normalize(to_world(s, normal));
}

static surface_t surface_of(const scene_t* scene, global const solid_t* solid, const hit_t* hit)
{
  switch (solid->material) {
    case MATERIAL_BRICK:
    case MATERIAL_PLASTER: return hit->face < FACE_TOP ? house(solid, hit) : roof(solid, hit);
    case MATERIAL_ROOF: return roof(solid, hit);
    case MATERIAL_PAVEMENT: return pavement(scene, solid, hit);
    case MATERIAL_CAR_BODY: return car_body(solid, hit);
    case MATERIAL_CAR_CABIN: return car_cabin(solid, hit);
    case MATERIAL_CAR_PANEL: return (surface_t){load3(solid->tint), CAR_PAINT, 0.0f};
    case MATERIAL_WHEEL: return wheel(hit);
    case MATERIAL_FOLIAGE: return foliage(solid, hit);
    case MATERIAL_BARK: return bark(solid, hit);
    case MATERIAL_HEAD:
    case MATERIAL_CLOTH: return person(solid, hit);
    default: return painted(solid, hit);
  }
}

// The colour of what the ray hits at z-depth s: solid `id`, the road (ROAD) or nothing (SKY).
enum { SKY = -2, ROAD = -1 };

static float3 colour_of(const scene_t* scene, float3 ray, float s, int id)
{
  global const view_t* view = scene->view;
  const float3 sun = load3(view->sun), unit_ray = normalize(ray);
  if (id == SKY) return cloudy_sky(unit_ray, sun, view->seed);
  hit_t hit = {s * ray, (float3)(0), (float3)(0, -1, 0), s * view->pixel, 1, FACE_TOP};
  global const solid_t* solid = scene->solids + max(id, 0);
  if (id != ROAD) {
    hit.own = to_local(solid, hit.point - load3(solid->centre));
    orient(solid, &hit);
  }
  if (dot(hit.normal, unit_ray) > 0) hit.normal = -hit.normal;  // the far side of a crown, from within
  hit.stretch = 1 / max(-dot(hit.normal, unit_ray), 0.03f);
  const surface_t surface = id == ROAD ? road(scene, &hit) : surface_of(scene, solid, &hit);
  const bool ground = id == ROAD || solid->material == MATERIAL_PAVEMENT;
  const float2 light = light_at(scene, hit.point + 0.01f * hit.normal, id, ground);
  return haze(shade(surface, hit.normal, unit_ray, sun, light), s);
}

kernel void raycast(
    const int height, const int width, const int tile_columns, const int solid_count, const int crossing_count,
    const int cell_rows, const int cell_columns,
    global const view_t* restrict view,          // [1]
    global const solid_t* restrict solids,       // [P]
    global const int4* restrict image_rects,     // [P]
    global const ushort* restrict tile_solids,   // [tiles, P]
    global const int* restrict tile_counts,      // [tiles]
    global const float4* restrict shadow_rects,  // [P]
    global const ushort* restrict cell_solids,   // [cells, P]
    global const int* restrict cell_counts,      // [cells]
    global const float2* restrict crossings,     // [crossings]
    global float* restrict colour,               // [3, H, W] out
    global float* restrict depth,                // [1, H, W] out
    global uchar* restrict labels)               // [1, H, W] out
{
  const int tile = get_global_id(0);
  const int y = tile / tile_columns * TILE + get_global_id(1), x0 = tile % tile_columns * TILE;
  if (y >= height) return;
  const scene_t scene = {view, solids, shadow_rects, cell_solids, cell_counts, crossings, solid_count, crossing_count,
                         cell_rows, cell_columns};
  const float3 left = multiply(view->ray, (float3)(x0 + 0.5f, y + 0.5f, 1));
  const float16 step = (float16)(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
  const float16 dx = left.x + step * view->ray[0], dy = left.y + step * view->ray[3], dz = left.z + step * view->ray[6];
  float rays_x[LANES], rays_y[LANES], rays_z[LANES], best[LANES];
  int hit[LANES];
  vstore16(dx, 0, rays_x);
  vstore16(dy, 0, rays_y);
  vstore16(dz, 0, rays_z);
  const float16 road = -view->camera[1] / dy;
  const int16 on_road = road > (float)NEAR && road < (float)SKY_DEPTH;
  vstore16(select((float16)(SKY_DEPTH), road, on_road), 0, best);
  vstore16(select((int16)(SKY), (int16)(ROAD), on_road), 0, hit);
  for (int k = 0; k < tile_counts[tile]; k++) {
    const int i = tile_solids[(size_t)tile * solid_count + k];
    if (y < image_rects[i].y || y >= image_rects[i].w) continue;
    float16 enter, exit;
    interval_float16(solids + i, (float3)(0), dx, dy, dz, &enter, &exit);
    if (solids[i].material == MATERIAL_FOLIAGE) {
      hit_foliage(solids + i, i, rays_x, rays_y, rays_z, enter, exit, best, hit);
    } else {
      const float16 nearest = vload16(0, best);
      const int16 nearer = enter < exit && enter > (float)NEAR && enter < nearest;
      vstore16(select(nearest, enter, nearer), 0, best);
      vstore16(select(vload16(0, hit), (int16)(i), nearer), 0, hit);
    }
  }
  for (int lane = 0; lane < min(LANES, width - x0); lane++) {
    const float3 ray = (float3)(rays_x[lane], rays_y[lane], rays_z[lane]);
    const float3 c = display(colour_of(&scene, ray, best[lane], hit[lane]));
    const size_t plane = (size_t)height * width, at = (size_t)y * width + x0 + lane;
    colour[at] = c.x;
    colour[plane + at] = c.y;
    colour[2 * plane + at] = c.z;
    depth[at] = best[lane];
    labels[at] = hit[lane] == SKY ? LABEL_SKY : hit[lane] == ROAD ? LABEL_ROAD : solids[hit[lane]].label;
  }
}
