// Surfaces of the static and dynamic objects on the street: cars, trees, people, poles.

#define CAR_PAINT 0.09f  // its mirror share

// The body: paint, dark sills and wheel arches, bumpers, lamps and number plates. It faces +z.
static surface_t car_body(global const solid_t* solid, const hit_t* hit)
{
  const float3 reach = load3(solid->half_size), at = hit->own;
  const float w = hit->footprint, up = reach.y - at.y;
  float3 paint = load3(solid->tint);
  float mirror = CAR_PAINT;
  if (hit->face == FACE_RIGHT || hit->face == FACE_LEFT) {
    const float wheel = length((float2)(fabs(at.z) - 0.62f * reach.z, up - 0.12f));
    const float arch = band(wheel, -1, 0.40f, w), sill = band(up, -1, 0.1f, w);
    const float door = centred(fabs(at.z - 0.12f * reach.z) - 0.5f, 0.012f, w) + centred(at.z - 0.1f, 0.012f, w);
    const float handle = centred(up - 0.47f, 0.02f, w) * centred(fold(at.z + 0.3f, 1.0f), 0.09f, w);
    paint *= 1 - 0.7f * door * (fabs(at.z) < 0.6f * reach.z) - 0.4f * handle * (fabs(at.z) < 0.5f * reach.z);
    const float dark = max(arch, sill);
    paint = mix(paint, (float3)(0.012f), dark);
    mirror *= 1 - dark;
  } else if (hit->face == FACE_FRONT || hit->face == FACE_BACK) {
    const bool front = hit->face == FACE_FRONT;
    const float side = fabs(at.x) / reach.x;
    const float bumper = band(up, -1, 0.16f, w), lamp = band(side, 0.58f, 0.94f, w) * band(up, 0.3f, 0.46f, w);
    const float grille = front ? centred(at.x, 0.45f, w) * band(up, 0.2f, 0.4f, w) : 0;
    const float plate = centred(at.x, 0.26f, w) * band(up, front ? 0.05f : 0.22f, front ? 0.16f : 0.34f, w);
    paint = mix(paint, (float3)(0.02f), max(bumper, 0.9f * grille));
    paint = mix(paint, front ? (float3)(0.75f, 0.76f, 0.72f) : (float3)(0.42f, 0.012f, 0.012f), lamp);
    paint = mix(paint, (float3)(0.62f, 0.62f, 0.56f), plate);
    mirror *= 1 - bumper;
  }
  return (surface_t){paint, mirror, 0.0f};
}

// The cabin: glass between pillars, the roof in the car's colour.
static surface_t car_cabin(global const solid_t* solid, const hit_t* hit)
{
  const float3 reach = load3(solid->half_size), at = hit->own;
  const float w = hit->footprint, up = (reach.y - at.y) / (2 * reach.y);
  if (hit->face >= FACE_TOP) return (surface_t){load3(solid->tint), CAR_PAINT, 0.0f};
  const bool side = hit->face == FACE_RIGHT || hit->face == FACE_LEFT;
  const float slope = hit->face == FACE_FRONT ? solid->taper[1] : solid->taper[2];
  const float end = side ? reach.z * (1 - (at.z > 0 ? solid->taper[1] : solid->taper[2]) * up)
                         : reach.x * (1 - solid->taper[0] * up);
  const float along = side ? at.z : at.x;
  float glass = band(fabs(along), -1e3f, end - (side ? 0.13f : 0.07f), w) * band(up, 0.06f, 0.86f, w / (2 * reach.y));
  if (side) glass *= 1 - centred(along + 0.05f, 0.045f, w);
  const float seats = side ? 0 : band(up, 0, 0.35f, w) * band(fabs(fabs(at.x) - 0.35f), -1, 0.2f, w);
  const float3 inside = mix((float3)(0.020f, 0.024f, 0.028f), (float3)(0.006f), seats);
  return (surface_t){mix(load3(solid->tint), inside, glass), mix(CAR_PAINT, 0.22f + 0.1f * slope, glass), 0.0f};
}

static surface_t wheel(const hit_t* hit)
{
  const float radius = length(hit->own.yz), w = hit->footprint;
  const float spokes = 0.5f + 0.5f * cos(5 * atan2(hit->own.y, hit->own.z));
  const float rim = band(radius, -1, 0.21f, w);
  const float3 metal = (float3)(0.34f) * (0.35f + 0.65f * mix(spokes, 1.0f, band(fabs(radius - 0.19f), -1, 0.02f, w)));
  return (surface_t){mix((float3)(0.016f), metal, rim), 0.05f * rim, 0.0f};
}

static float leaves(global const solid_t* solid, float3 own)
{
  return 0.45f * noise3(own * 2.3f, solid->seed) + 0.55f * noise3(own * 8.7f, solid->seed + 77);
}

// A crown is a shell of leaves: rays pass where the noise is low.
static bool is_gap(global const solid_t* solid, float3 own) { return leaves(solid, own) < 0.53f; }

static surface_t foliage(global const solid_t* solid, const hit_t* hit)
{
  const float leaf = leaves(solid, hit->own);
  const float depth = 0.5f + 0.5f * dot(hit->own / load3(solid->half_size), (float3)(0, -1, 0));  // 1 on top, 0 below
  const float seen = visible(0.07f, hit->footprint);
  const float single = seen > 0 ? seen * (smoothstep(0.3f, 0.7f, noise3(hit->own * 19, solid->seed + 5)) - 0.5f) : 0;
  const float3 colour = load3(solid->tint) * (0.4f + 2.2f * (leaf - 0.45f)) * (0.5f + 0.6f * depth);
  const float3 hue = (float3)(1 + 0.5f * single, 1, 1 - 0.4f * single);  // sunlit leaves are yellower
  return (surface_t){shaded(colour * hue, 0.8f * single), 0.0f, 0.4f};
}

static surface_t bark(global const solid_t* solid, const hit_t* hit)
{
  const float turn = atan2(hit->own.z, hit->own.x) * 0.18f;
  const float ridges = grain((float2)(turn, 0.12f * hit->own.y), 0.025f, hit->footprint, solid->seed);
  const float moss = grain((float2)(turn, hit->own.y), 0.3f, hit->footprint, solid->seed + 1);
  return (surface_t){shaded(load3(solid->tint), 0.45f * ridges + 0.2f * moss), 0.0f, 0.0f};
}

// Skin below, hair above and behind; cloth has folds.
static surface_t person(global const solid_t* solid, const hit_t* hit)
{
  const float3 at = hit->own / load3(solid->half_size);
  if (solid->material == MATERIAL_HEAD) {
    const bool hair = at.y < -0.25f - 0.7f * at.z;
    const float3 hair_tint = (float3)(0.05f, 0.03f, 0.02f) * (1 + 2 * (float)(solid->seed & 3));
    return (surface_t){hair ? hair_tint : load3(solid->tint), 0, 0};
  }
  const float folds = grain(hit->own.xy * (float2)(1, 0.4f), 0.06f, hit->footprint, solid->seed);
  return (surface_t){shaded(load3(solid->tint), 0.3f * folds), 0.0f, 0.0f};
}

static surface_t painted(global const solid_t* solid, const hit_t* hit)
{
  const float rust = grain(hit->own.xy + hit->own.z, 0.15f, hit->footprint, solid->seed);
  return (surface_t){shaded(load3(solid->tint), 0.15f * rust), 0.04f, 0.0f};
}
