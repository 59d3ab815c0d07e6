// Which face of a solid a point of its surface is on, and the normal there.

#define EDGE 0.09f  // how far from a car's edges its normal bends, metres

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
