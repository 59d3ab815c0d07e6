// What the ray caster's files share. Every coordinate is relative to the camera, in world axes (x right, y down,
// z forward, metres), so that float32 stays exact to a millimetre however far the camera has driven.
// The structures mirror SOLID and VIEW in vestcl/data/street/raycast.py, field by field.
#ifndef SKY_DEPTH
#error "define SKY_DEPTH, MATERIAL_*, SHAPE_*, LABEL_* and SHADOW_CELL: see vestcl/data/street/raycast.py"
#endif

#if !defined(SOLID_BYTES) || !defined(VIEW_BYTES) || (defined(BENT) && !defined(COURSE_BYTES))
#error "define SOLID_BYTES, VIEW_BYTES and of a bent street COURSE_BYTES, the host's sizes of the structures"
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
  int instance;   // of dynamic objects; 0: static
} solid_t;
ASSERT_SIZE(solid_t, SOLID_BYTES);

typedef struct {
  float ray[9];        // R K^-1: pixel (u, v, 1) to the direction whose z-depth is 1
  float project[9];    // K R^T: a point to its homogeneous pixel
  float camera[3];     // where the camera is in the world; the road is y = 0
  float sun[3];        // unit vector towards it
  float pixel;         // width of one ray at 1 m, metres
  float lane, kerb;    // centre line to edge line and to kerb, metres
  float grid[2];       // x and z of the shadow grid's corner
  uint seed;
} view_t;
ASSERT_SIZE(view_t, VIEW_BYTES);

#ifdef BENT
// A point of a bent street's middle line, COURSE_STEP metres along it from the one before.
typedef struct {
  float place[2];  // x and z from the camera, metres
  float ahead[2];  // unit vector along the line
  float curvature; // 1/m, positive to the right
  float along;     // metres along the street
} course_t;
ASSERT_SIZE(course_t, COURSE_BYTES);
#endif

// What a kernel knows of the scene: the solids and, per cell of a grid on the road, those whose shadow may fall there.
typedef struct {
  global const view_t* view;
  global const solid_t* solids;        // [P]
  global const float4* shadow_rects;   // [P] x and z where a shadow falls on the road, metres
  global const ushort* cell_solids;    // [rows * columns, P]
  global const int* cell_counts;       // [rows * columns]
  global const float2* crossings;      // [crossings] z where a side street begins and ends
  int solid_count, crossing_count, cell_rows, cell_columns;
#ifdef BENT
  global const course_t* course;       // [course_points]
  int course_points;
#endif
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

// Where a point on the ground is on the street.
typedef struct {
  float2 at;    // metres to the right of the middle line, and along it
  float2 away;  // |unit vector from the camera to the point|, across the street and along it
} place_t;

#ifdef BENT
// The nearest of every COARSE-th point of the middle line, then Newton's steps: s += u / (1 - k v), with the point's u
// ahead and v to the right of the line's.
static place_t place_of(const scene_t* scene, float2 point)
{
  int best = 0;
  float nearest = INFINITY;
  for (int i = 0; i < scene->course_points; i += COARSE) {
    const float2 apart = point - (float2)(scene->course[i].place[0], scene->course[i].place[1]);
    if (dot(apart, apart) >= nearest) continue;
    nearest = dot(apart, apart);
    best = i;
  }
  float u = 0, v = 0, scale = 1;
  for (int k = 0; k < NEWTON; k++) {
    best = clamp(best + (int)round(u / (scale * COURSE_STEP)), 0, scene->course_points - 1);
    global const course_t* c = scene->course + best;
    const float2 apart = point - (float2)(c->place[0], c->place[1]);
    u = apart.x * c->ahead[0] + apart.y * c->ahead[1];
    v = apart.x * c->ahead[1] - apart.y * c->ahead[0];
    scale = max(1 - c->curvature * v, 0.3f);
  }
  global const course_t* c = scene->course + best;
  const float2 unit = normalize(point);
  const float2 turned = (float2)(unit.x * c->ahead[1] - unit.y * c->ahead[0], unit.x * c->ahead[0] + unit.y * c->ahead[1]);
  return (place_t){(float2)(v - 0.5f * c->curvature * u * u / scale, c->along + u / scale), fabs(turned)};
}
#else
static place_t place_of(const scene_t* scene, float2 point)
{
  return (place_t){point + (float2)(scene->view->camera[0], scene->view->camera[2]), fabs(normalize(point))};
}
#endif
