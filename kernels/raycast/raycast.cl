// The procedural street, seen by a pinhole camera. A pixel's ray is s (R K^-1) (u, v, 1), scaled so that s is its
// z-depth; the nearest of the road plane and all solids gives depth and label, and its surface is shaded.
//   project_solids  one work-item a solid: its rectangle on the image, and where its shadow falls on the road
//   list_solids     one work-item per row of cells (image tiles, or squares of road): which rectangles touch each cell
//   raycast         one work-item per LANES pixels of a row: intersects its tile's solids LANES pixels at a time, then
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
#include "raycast_objects.h"
#include "raycast_light.h"
#include "raycast_normals.h"
#include "raycast_trace.h"

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
    const int height, const int width, const int cell_rows, const int cell_columns, const int solid_count,
    global const view_t* restrict view,      // [1]
    global const solid_t* restrict solids,   // [P]
    global int4* restrict image_rects,       // [P] out, pixels
    global int4* restrict shadow_cells,      // [P] out
    global float4* restrict shadow_rects)    // [P] out, metres
{
  const int i = get_global_id(0);
  if (i >= solid_count) return;
  image_rects[i] = image_rect(view, solids + i, height, width);
  shadow_rects[i] = shadow_rect(view, solids + i);
  shadow_cells[i] = cells_of(view, solids + i, shadow_rects[i], cell_rows, cell_columns);
}

kernel void list_solids(
    const int rows, const int columns, const int cell, const int solid_count,
    global const int4* restrict rects,       // [P], in units of 1 / cell
    global ushort* restrict cell_solids,     // [rows * columns, P] out, in ascending order
    global int* restrict cell_counts)        // [rows * columns] out
{
  const int row = get_global_id(0);
  if (row >= rows) return;
  global int* counts = cell_counts + row * columns;
  for (int c = 0; c < columns; c++) counts[c] = 0;
  for (int i = 0; i < solid_count; i++) {
    const int4 r = rects[i];
    if (r.x >= r.z || r.y >= (row + 1) * cell || r.w <= row * cell) continue;
    for (int c = r.x / cell; c <= (r.z - 1) / cell; c++)
      cell_solids[((size_t)row * columns + c) * solid_count + counts[c]++] = i;
  }
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

// Linear light from what the ray hits at z-depth s: solid `id`, ROAD or SKY. The ray is `pixel` metres wide at 1 m.
static float3 colour_of(const scene_t* scene, float3 ray, float s, int id, float pixel)
{
  global const view_t* view = scene->view;
  const float3 sun = load3(view->sun), unit_ray = normalize(ray);
  if (id == SKY) return cloudy_sky(unit_ray, sun, view->seed);
  hit_t hit = {s * ray, (float3)(0), (float3)(0, -1, 0), s * pixel, 1, FACE_TOP};
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

#ifdef BENT
// Marks the pixels all of whose rays meet one smooth surface, and shades each once, by the centre's ray: textures are
// filtered for the width of a ray. On a plane the mean of 1 / z over rays is that of the centre. Returns
// whether these are all of the row.
static bool shade_plain(
    const scene_t* scene, global const ushort* listed, int count, global const int4* image_rects, int y, int x0,
    int samples, int lanes, const row_t* centre, int* plain, float3* light)
{
  const int rays = samples * samples;
  row_t row;
  float inverse[LANES];
  for (int lane = 0; lane < LANES; lane++) {
    inverse[lane] = 0;
    plain[lane] = 1;
  }
  for (int pass = 0; pass < rays; pass++) {
    const float2 inside = (float2)(pass % samples + 0.5f, pass / samples + 0.5f) / samples;
    const float3 left = multiply(scene->view->ray, (float3)(x0 + inside.x, y + inside.y, 1));
    trace(scene, listed, count, image_rects, y, left, &row);
    for (int lane = 0; lane < lanes; lane++) {
      plain[lane] &= row.hit[lane] == centre->hit[lane];
      inverse[lane] += 1 / row.best[lane];
    }
  }
  bool all_plain = true;
  for (int lane = 0; lane < lanes; lane++) {
    plain[lane] &= fabs(inverse[lane] * centre->best[lane] / rays - 1) < SMOOTH;
    all_plain = all_plain && plain[lane];
    if (!plain[lane]) continue;
    const float3 ray = (float3)(centre->x[lane], centre->y[lane], centre->z[lane]);
    const float pixel = samples * scene->view->pixel;
    light[lane] = rays * colour_of(scene, ray, centre->best[lane], centre->hit[lane], pixel);
  }
  return all_plain;
}
#endif

// Depth, label and instance are of the ray through a pixel's centre. Colour is the mean over samples x samples rays per
// pixel in linear light, as a sensor sums it, and only then goes through the film curve: display() of a mean.
kernel void raycast(
    const int height, const int width, const int tile_rows, const int tile_columns, const int solid_count, const int crossing_count,
    const int cell_rows, const int cell_columns,
    const int samples,                           // 0 leaves colour as it is
    const int with_instances,                    // 0 leaves instances as they are
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
    global uchar* restrict labels,               // [1, H, W] out
    global int* restrict instances               // [1, H, W] out
#ifdef BENT
    , const int course_points,
    global const course_t* restrict course       // [course_points]
#endif
    )
{
  const int tile = get_global_id(0);
  const int y = tile / tile_columns * TILE + get_global_id(1), x0 = tile % tile_columns * TILE;
  if (tile >= tile_rows * tile_columns || y >= height) return;
  const scene_t scene = {view, solids, shadow_rects, cell_solids, cell_counts, crossings, solid_count, crossing_count,
                         cell_rows, cell_columns,
#ifdef BENT
                         course, course_points,
#endif
  };
  global const ushort* listed = tile_solids + (size_t)tile * solid_count;
  const int lanes = min(LANES, width - x0), rays = samples * samples;
  const size_t plane = (size_t)height * width, at = (size_t)y * width + x0;
  row_t row;
  float3 light[LANES];
  int plain[LANES];  // whether a pixel's colour is known without its own rays
  for (int lane = 0; lane < LANES; lane++) {
    light[lane] = 0;
    plain[lane] = 0;
  }
  for (int pass = samples > 1 ? -1 : 0; pass < max(rays, 1); pass++) {  // of several rays, first the centre's
    const bool centre = samples < 2 || pass < 0;
    const float2 inside = centre ? (float2)(0.5f) : (float2)(pass % samples + 0.5f, pass / samples + 0.5f) / samples;
    const float3 left = multiply(view->ray, (float3)(x0 + inside.x, y + inside.y, 1));
    trace(&scene, listed, tile_counts[tile], image_rects, y, left, &row);
    for (int lane = 0; lane < lanes && centre; lane++) {
      const int id = row.hit[lane];
      depth[at + lane] = row.best[lane];
      labels[at + lane] = id == SKY ? LABEL_SKY : id == ROAD ? LABEL_ROAD : solids[id].label;
      if (with_instances) instances[at + lane] = id < 0 ? 0 : solids[id].instance;
    }
    for (int lane = 0; lane < lanes && pass >= 0 && rays > 0; lane++) {
      if (plain[lane]) continue;
      const float3 ray = (float3)(row.x[lane], row.y[lane], row.z[lane]);
      light[lane] += colour_of(&scene, ray, row.best[lane], row.hit[lane], view->pixel);
    }
#ifdef BENT
    if (pass < 0 &&
        shade_plain(&scene, listed, tile_counts[tile], image_rects, y, x0, samples, lanes, &row, plain, light))
      break;
#endif
  }
  for (int lane = 0; lane < lanes && rays > 0; lane++) {
    const float3 c = display(light[lane] / rays);
    colour[at + lane] = c.x;
    colour[plane + at + lane] = c.y;
    colour[2 * plane + at + lane] = c.z;
  }
}
