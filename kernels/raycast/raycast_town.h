// Surfaces of the street itself: road, pavement, house fronts, roofs. Colours are linear RGB, lengths metres.

typedef struct {
  float3 point;    // from the camera, world axes
  float3 own;    // from the solid's centre, its own axes
  float3 normal;   // unit, world axes, towards the camera's side
  float footprint; // width of the pixel there, across the ray
  float stretch;   // how much longer it is along the surface, away from the camera
  int face;        // of a box: FACE_*
} hit_t;

typedef struct {
  float3 albedo;
  float mirror;   // share of the sky reflected when seen head on
  float through;  // share of sunlight that passes from behind: leaves
} surface_t;

enum { FACE_RIGHT, FACE_LEFT, FACE_FRONT, FACE_BACK, FACE_TOP, FACE_BOTTOM };

static float3 shaded(float3 colour, float change) { return colour * max(0.0f, 1 + change); }

// Asphalt with patches, tyre tracks and grain.
static float3 asphalt(float2 at, float2 footprint, float lane, uint seed)
{
  const float width = sqrt(footprint.x * footprint.y);
  const float track = fabs(fabs(at.x) - 0.5f * lane);
  float change = 0.20f * grain(at, 4.1f, width, seed) + 0.14f * grain(at, 0.7f, width, seed + 1);
  change += 0.20f * grain(at, 0.13f, width, seed + 2) + 0.30f * grain(at, 0.035f, width, seed + 3);
  change += 0.10f * centred(track - 0.72f, 0.25f, 0.3f) - 0.12f * centred(track, 0.3f, 0.3f);
  const float patch = random((int)floor(at.x / 2.6f), (int)floor(at.y / 7.3f), seed + 4);
  change -= patch > 0.86f ? 0.28f : 0.0f;
  const float wobble = 0.25f * noise2(at * 0.9f, seed + 5) + 0.08f * noise2(at * 5, seed + 5);
  const float crack = lines(at.y + wobble * 4 + 0.1f * at.x, 9.7f, 0.03f, footprint.y);
  const float seam = lines(at.x + 0.1f * wobble, 2 * lane, 0.03f, footprint.x);
  return shaded((float3)(0.118f, 0.118f, 0.124f), change) * (1 - 0.6f * max(crack, seam));
}

// White paint on the road in [0, 1]: dashed centre, solid edges; zebra and stop line at side streets.
static float markings(const scene_t* scene, float2 at, float2 footprint)
{
  const float lane = scene->view->lane, kerb = scene->view->kerb;
  const float dashes = centred(fold(at.y, 7.5f), 1.6f, min(footprint.y, 7.5f)) * centred(at.x, 0.07f, footprint.x);
  float paint = dashes + centred(fabs(at.x) - lane, 0.06f, footprint.x);
  for (int i = 0; i < scene->crossing_count; i++) {
    const float begin = scene->crossings[i].x, end = scene->crossings[i].y;
    if (at.y < begin - 7 || at.y > end + 7) continue;
    const float middle = 0.5f * (begin + end), reach = 0.5f * (end - begin);
    const float out = fabs(at.y - middle) - reach;  // metres before the side street
    const float stripes = lines(at.x + 0.5f, 1, 0.5f, footprint.x) * centred(at.x, kerb - 0.3f, footprint.x);
    const float before = at.x > 0 ? at.y < middle : at.y > middle;
    const float stop = before * centred(out - 5.2f, 0.2f, footprint.y) *
                       centred(fabs(at.x) - 0.5f * lane, 0.45f * lane, 0.1f);
    const float share = 1 - band(out, -1e3f, 5.4f, footprint.y);
    paint = paint * share + stripes * centred(out - 2.7f, 1.5f, footprint.y) + stop;
  }
  return min(paint, 1.0f);
}

static surface_t road(const scene_t* scene, const hit_t* hit)
{
  global const view_t* view = scene->view;
  const place_t place = place_of(scene, hit->point.xz);
  const float2 at = place.at, away = place.away;
  const float2 footprint = hit->footprint * (1 + (hit->stretch - 1) * away);
  float3 colour = asphalt(at, footprint, view->lane, view->seed);
  const float paint = fabs(at.x) < view->kerb ? markings(scene, at, footprint) : 0;
  if (paint > 0) {
    const float width = sqrt(footprint.x * footprint.y);
    const float worn =
        0.62f + 0.18f * grain(at, 0.5f, width, view->seed + 7) + 0.2f * grain(at, 0.06f, width, view->seed + 8);
    colour = mix(colour, (float3)(0.72f, 0.71f, 0.67f), paint * clamp(worn + 0.2f, 0.0f, 1.0f));
  }
  const float gutter = centred(fabs(at.x) - view->kerb + 0.15f, 0.15f, footprint.x);
  return (surface_t){colour * (1 - 0.35f * gutter), 0.0f, 0.0f};
}

// Paving slabs behind a granite kerb.
static surface_t pavement(const scene_t* scene, global const solid_t* solid, const hit_t* hit)
{
  const place_t place = place_of(scene, hit->point.xz);
  const float2 at = place.at, away = place.away;
  const float2 footprint = hit->footprint * (1 + (hit->stretch - 1) * away);
  const float width = sqrt(footprint.x * footprint.y);
  const float inside = fabs(at.x) - scene->view->kerb;
  const float speckle = 0.18f * grain(at, 0.05f, width, 21) + 0.16f * grain(at, 0.6f, width, 22);
  if (inside < 0.2f) {
    const float joint = lines(at.y, 1, 0.025f, footprint.y);
    const float tone = 0.1f * (random((int)floor(at.y), 3, solid->seed) - 0.5f);
    return (surface_t){shaded((float3)(0.42f, 0.41f, 0.39f), speckle + tone - 0.5f * joint), 0.0f, 0.0f};
  }
  const float row = floor(inside / 0.5f), shift = 0.25f * ((int)row & 1);
  const float slab = random((int)row, (int)floor((at.y + shift) / 0.5f), solid->seed) - 0.5f;
  const float joint = max(lines(inside, 0.5f, 0.02f, footprint.x), lines(at.y + shift, 0.5f, 0.02f, footprint.y));
  const float tone = 0.3f * slab * visible(0.5f, width) + 0.2f * grain(at, 2.7f, width, 23);
  return (surface_t){shaded(load3(solid->tint), speckle + tone - 0.45f * joint), 0.0f, 0.0f};
}

// Bricks in running bond, or plaster with stains.
static float3 wall(global const solid_t* solid, float along, float up, float2 footprint)
{
  const float width = sqrt(footprint.x * footprint.y);
  const float2 at = (float2)(along, up);
  float stain = 0.10f * grain(at, 2.3f, width, solid->seed) + 0.07f * grain(at, 0.4f, width, solid->seed + 1);
  stain += 0.10f * grain((float2)(along, 0.15f * up), 0.25f, width, solid->seed + 2);
  if (solid->material == MATERIAL_PLASTER)
    return shaded(load3(solid->tint), stain + 0.07f * grain(at, 0.06f, width, solid->seed + 3));
  const float row = floor(up / 0.1f), shift = 0.15f * ((int)row & 1);
  const float brick = random((int)floor((along + shift) / 0.3f), (int)row, solid->seed) - 0.5f;
  const float joint = max(lines(up, 0.1f, 0.016f, footprint.y), lines(along + shift, 0.3f, 0.016f, footprint.x));
  const float3 colour = shaded(load3(solid->tint), stain + 0.55f * brick * visible(0.2f, width));
  return mix(colour, (float3)(0.36f, 0.34f, 0.31f), joint * 0.75f);
}

// One window or shop front, `reach` to each side of its middle, `top` high above its sill.
static surface_t window(surface_t wall, float x, float y, float reach, float top, uint key, float2 footprint)
{
  const float frame = centred(x, reach, footprint.x) * band(y, 0, top, footprint.y);
  const float glass = centred(x, reach - 0.07f, footprint.x) * band(y, 0.07f, top - 0.07f, footprint.y);
  const float bars = max(centred(x, 0.03f, footprint.x), centred(y - 0.68f * top, 0.025f, footprint.y));
  const float sill = centred(x, reach + 0.12f, footprint.x) * band(y, -0.13f, 0, footprint.y);
  const float lintel = centred(x, reach + 0.1f, footprint.x) * band(y, top, top + 0.17f, footprint.y);
  const float shade = band(y, -0.5f, -0.13f, footprint.y) * centred(x, reach + 0.05f, footprint.x);
  const float kind = random(1, 2, key), drop = top * (0.25f + 0.6f * random(3, 4, key));
  const bool shop = top > 2;
  const float heap = shop ? noise2((float2)(3.1f * x, 2.3f * y), key) : 0;
  const float goods = smoothstep(0.45f, 0.75f, heap) * band(y, 0, 1.6f, 0.5f);
  const float3 ware = (float3)(random(5, 6, key), random(7, 8, key), random(9, 10, key)) * 0.3f + 0.05f;
  const float3 lit = kind < 0.12f ? (float3)(0.30f, 0.21f, 0.10f) : (float3)(0.022f, 0.028f, 0.036f) * (0.6f + kind);
  const float3 inside = mix(shop ? (float3)(0.05f, 0.045f, 0.04f) : lit, ware, goods);
  const float curtain = kind > 0.55f && !shop ? band(y, top - drop, top, footprint.y) : 0;
  const float recess = max(band(y, top - 0.2f, top, footprint.y), band(x, -reach, -reach + 0.13f, footprint.x));
  float3 pane = mix(inside, (float3)(0.42f, 0.41f, 0.37f) * (0.5f + 0.4f * kind), curtain);
  pane = mix(pane * (1 - 0.6f * recess), (float3)(0.55f, 0.54f, 0.5f), bars);
  wall.albedo *= 1 - 0.22f * shade;
  wall.albedo = mix(wall.albedo, (float3)(0.46f, 0.44f, 0.40f), min(1.0f, sill + 0.6f * lintel));
  wall.albedo = mix(mix(wall.albedo, (float3)(0.58f, 0.57f, 0.53f), frame), pane, glass);
  wall.mirror = 0.30f * glass * (1 - 0.8f * bars) * (1 - 0.5f * recess);
  return wall;
}

// The wall of a house: storeys of windows above doors and shops, a plinth, string courses and a cornice.
static surface_t house(global const solid_t* solid, const hit_t* hit)
{
  const bool side = hit->face == FACE_RIGHT || hit->face == FACE_LEFT;
  const float along = side ? hit->own.z : hit->own.x;
  const float length = 2 * (side ? solid->half_size[2] : solid->half_size[0]);
  const float up = solid->half_size[1] - hit->own.y, height = 2 * solid->half_size[1];
  const float2 footprint = hit->footprint * (float2)(hit->stretch, 1);
  const uint seed = solid->seed;
  surface_t s = {wall(solid, along, up, footprint), 0.0f, 0.0f};
  const float ground = 3.7f, bay = 2.1f + 1.1f * random(1, 0, seed);
  const float columns = max(1.0f, floor((length - 0.6f) / bay)), cell = (length - 0.6f) / columns;
  const float storeys = max(1.0f, round((height - ground - 0.5f) / 3.1f)), storey = (height - ground - 0.5f) / storeys;
  const float column = clamp(floor((along + 0.5f * length - 0.3f) / cell), 0.0f, columns - 1);
  const float x = along + 0.5f * length - 0.3f - (column + 0.5f) * cell;
  const float level = up < ground ? -1 : min(floor((up - ground) / storey), storeys - 1);
  const uint key = hash((uint)(int)column, (uint)(int)level, seed + hit->face);
  const float plinth = band(up, 0, 0.6f, footprint.y);
  const float course =
      centred(up - ground, 0.12f, footprint.y) + 0.8f * band(up, height - 0.5f, height - 0.1f, footprint.y);
  const float under =
      band(up, ground - 0.5f, ground - 0.12f, footprint.y) + band(up, height - 0.9f, height - 0.5f, footprint.y);
  s.albedo = mix(s.albedo, (float3)(0.24f, 0.23f, 0.22f), 0.75f * plinth) * (1 - 0.3f * under);
  if (level >= 0) {
    const float y = up - ground - level * storey - 0.85f;
    s = window(s, x, y, min(0.62f, 0.3f * cell), storey - 1.35f, key, footprint);
  } else if (random(2, 0, seed) < 0.45f) {  // a row of shops under an awning
    s = window(s, x, up - 0.55f, 0.45f * cell, 2.35f, key, footprint);
    const float stripe = lines(along, 0.6f, 0.3f, footprint.x);
    const float3 cloth = random(3, 0, seed) < 0.5f ? (float3)(0.45f, 0.07f, 0.06f) : (float3)(0.06f, 0.2f, 0.14f);
    s.albedo = mix(s.albedo, mix(cloth, (float3)(0.6f), stripe), band(up, 2.9f, 3.4f, footprint.y));
  } else if ((key & 3) == 0) {
    const float door = centred(x, 0.55f, footprint.x) * band(up, 0.1f, 2.4f, footprint.y);
    const float panel = centred(fabs(x) - 0.25f, 0.16f, footprint.x) * centred(fold(up - 0.7f, 1), 0.36f, footprint.y);
    const float3 wood = mix((float3)(0.15f, 0.06f, 0.03f), (float3)(0.03f, 0.09f, 0.10f), random(5, 0, key));
    s.albedo = mix(s.albedo, wood * (1 - 0.4f * panel), door);
  } else {
    s = window(s, x, up - 1.1f, min(0.62f, 0.3f * cell), 1.7f, key, footprint);
  }
  s.albedo = mix(s.albedo, (float3)(0.47f, 0.45f, 0.41f), min(1.0f, course));
  return s;
}

// Rows of tiles, or felt on a flat top.
static surface_t roof(global const solid_t* solid, const hit_t* hit)
{
  const float2 at = (float2)(hit->own.z, 1.6f * hit->own.y + (hit->face >= FACE_TOP ? hit->own.x : 0));
  const float width = hit->footprint * sqrt(hit->stretch);
  const float row = floor(at.y / 0.3f), tile = random((int)floor(at.x / 0.25f), (int)row, solid->seed) - 0.5f;
  const float edge = lines(at.y, 0.3f, 0.06f, width);
  const float change = 0.5f * tile * visible(0.25f, width) + 0.15f * grain(at, 1.7f, width, solid->seed) - 0.4f * edge;
  return (surface_t){shaded(load3(solid->tint), change), 0.0f, 0.0f};
}
