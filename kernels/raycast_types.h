// What the ray caster's files share. Every coordinate is relative to the camera, in world axes (x right, y down,
// z forward, metres), so that float32 stays exact to a millimetre however far the camera has driven.
// The structures mirror SOLID and VIEW in vestcl/data/raycast.py, field by field.
#ifndef SKY_DEPTH
#error "define SKY_DEPTH, MATERIAL_*, SHAPE_*, LABEL_* and SHADOW_CELL: see vestcl/data/raycast.py"
#endif

#define LANES 16  // pixels of a row that are intersected together, one 512-bit register of float
#define TINY 1e-9f

// A convex body. Its own axes are the world's, turned by yaw about y; its surface is that of a unit box, cylinder
// (axis y) or sphere, times half_size. A box's top may be narrower: taper is the share that its sides, front and
// back lose from bottom to top.
typedef struct {
  float centre[3];
  float half_size[3];
  float cos_yaw, sin_yaw;
  float taper[3];
  float tint[3];  // linear RGB
  int shape, material, label;
  uint seed;
  int instance;   // of what moves; 0 stands still
} solid_t;

typedef struct {
  float ray[9];        // R K^-1: pixel (u, v, 1) to the direction whose z-depth is 1
  float project[9];    // K R^T: a point to its homogeneous pixel
  float camera[3];     // where the camera is in the world; the road is y = 0
  float sun[3];        // unit vector towards it
  float pixel;         // width of what one ray stands for at 1 m, metres
  float lane, kerb;    // centre line to edge line and to kerb, metres
  float grid[2];       // x and z of the shadow grid's corner
  uint seed;
} view_t;

// What a kernel knows of the scene: the solids and, per cell of a grid on the road, those whose shadow may fall there.
typedef struct {
  global const view_t* view;
  global const solid_t* solids;        // [P]
  global const float4* shadow_rects;   // [P] x and z where a shadow falls on the road, metres
  global const ushort* cell_solids;    // [rows * columns, P]
  global const int* cell_counts;       // [rows * columns]
  global const float2* crossings;      // [crossings] z where a side street begins and ends
  int solid_count, crossing_count, cell_rows, cell_columns;
} scene_t;

static float3 load3(global const float* a) { return (float3)(a[0], a[1], a[2]); }

static float3 to_local(global const solid_t* s, float3 p)
{
  return (float3)(s->cos_yaw * p.x - s->sin_yaw * p.z, p.y, s->sin_yaw * p.x + s->cos_yaw * p.z);
}

static float3 to_world(global const solid_t* s, float3 p)
{
  return (float3)(s->cos_yaw * p.x + s->sin_yaw * p.z, p.y, s->cos_yaw * p.z - s->sin_yaw * p.x);
}
