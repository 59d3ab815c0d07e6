// Sky, sun, shadows and what reaches the eye.

#define SUNLIGHT ((float3)(3.1f, 2.75f, 2.25f))
#define HORIZON ((float3)(0.62f, 0.74f, 0.90f))
#define ZENITH ((float3)(0.055f, 0.20f, 0.60f))
#define HAZE_REACH 210.0f  // metres; the square in haze() hides what the generator no longer builds

static float3 clear_sky(float3 ray, float3 sun)
{
  const float up = max(-ray.y, 0.0f), towards = max(dot(ray, sun), 0.0f);
  const float glow = towards * towards * towards * towards;
  return mix(HORIZON, ZENITH, 1 - 1 / (1 + 4.5f * up)) + 0.22f * glow * (float3)(1.0f, 0.9f, 0.7f);
}

static float cloud(float2 at, uint seed)
{
  float sum = 0, size = 0.5f;
  for (int octave = 0; octave < 4; octave++) {
    sum += size * noise2(at, seed + octave);
    at = (float2)(1.7f * at.x + 1.1f * at.y, 1.7f * at.y - 1.1f * at.x);
    size *= 0.5f;
  }
  return sum;
}

static float3 cloudy_sky(float3 ray, float3 sun, uint seed)
{
  const float up = max(-ray.y, 0.0f);
  const float2 at = ray.xz / (up + 0.13f) * 1.3f;
  const float density = cloud(at, seed);
  const float share = smoothstep(0.47f, 0.66f, density) * smoothstep(0.0f, 0.12f, up);
  const float lit = clamp(0.75f + 2.2f * (density - cloud(at + 0.16f * sun.xz, seed)), 0.25f, 1.0f);
  const float3 white = mix((float3)(0.55f, 0.60f, 0.68f), (float3)(1.15f, 1.1f, 1.02f), lit);
  return mix(clear_sky(ray, sun), white, 0.9f * share);
}

// (sunlight, daylight) that reach a point, 0 or 1 and in [0, 1]: a shadow ray through the solids of the cell where
// the point's own shadow falls; daylight is dimmed on the ground next to and below a car.
static float2 light_at(const scene_t* scene, float3 point, int own, bool ground)
{
  const float3 sun = load3(scene->view->sun);
  const float fall = (-scene->view->camera[1] - point.y) / sun.y;
  const float2 fallen = point.xz + sun.xz * fall;
  const int column = (int)floor((fallen.x - scene->view->grid[0]) / SHADOW_CELL);
  const int row = (int)floor((fallen.y - scene->view->grid[1]) / SHADOW_CELL);
  if (column < 0 || row < 0 || column >= scene->cell_columns || row >= scene->cell_rows) return (float2)(1, 1);
  const int cell = row * scene->cell_columns + column;
  float2 light = 1;
  for (int k = 0; k < scene->cell_counts[cell]; k++) {
    const int i = scene->cell_solids[(size_t)cell * scene->solid_count + k];
    const float4 rect = scene->shadow_rects[i];
    if (i == own || fallen.x < rect.x || fallen.y < rect.y || fallen.x > rect.z || fallen.y > rect.w) continue;
    global const solid_t* solid = scene->solids + i;
    if (ground && solid->material == MATERIAL_CAR_BODY) {
      const float3 at = fabs(to_local(solid, point - load3(solid->centre))) - load3(solid->half_size);
      light.y *= 0.3f + 0.7f * smoothstep(-0.35f, 0.45f, length(max(at.xz, (float2)(-0.2f)) + 0.2f) - 0.2f);
    }
    if (light.x == 0) continue;
    float enter, exit;
    interval_float(solid, point, sun.x, sun.y, sun.z, &enter, &exit);
    if (enter >= exit || exit <= 0.02f) continue;
    if (solid->material == MATERIAL_FOLIAGE) {
      const float3 from = point - load3(solid->centre);
      if (is_gap(solid, to_local(solid, from + enter * sun)) && is_gap(solid, to_local(solid, from + exit * sun)))
        continue;
    }
    light.x = 0;
  }
  return light;
}

static float3 reflected(float3 ray, float3 sun)
{
  const float3 street = (float3)(0.16f, 0.15f, 0.14f);  // the other side of it, in a low mirror
  return mix(street, clear_sky(ray, sun), smoothstep(0.02f, 0.32f, -ray.y));
}

static float3 shade(surface_t surface, float3 normal, float3 ray, float3 sun, float2 light)
{
  const float facing = dot(normal, sun);
  const float direct = light.x * (max(facing, 0.0f) + surface.through * max(-facing, 0.0f));
  const float3 ambient = mix((float3)(0.26f, 0.25f, 0.24f), (float3)(0.50f, 0.62f, 0.82f), 0.5f - 0.5f * normal.y);
  float3 colour = surface.albedo * (SUNLIGHT * direct + ambient * light.y);
  if (surface.mirror > 0) {
    const float3 away = ray - 2 * dot(ray, normal) * normal;
    const float graze = 1 - clamp(-dot(ray, normal), 0.0f, 1.0f), glance = max(dot(away, sun), 0.0f);
    const float power = glance * glance * glance * glance * glance * glance;
    const float share = surface.mirror + min(0.5f, 3 * surface.mirror) * graze * graze * graze;
    const float glint = 9 * min(surface.mirror, 0.1f) * power * power * power * power;
    colour = mix(colour, reflected(away, sun), min(share, 0.8f)) + light.x * glint;
  }
  return colour;
}

static float3 haze(float3 colour, float z)
{
  const float share = z / HAZE_REACH;
  return mix(HORIZON, colour, exp(-share * share));
}

// Linear light to a display's [0, 1]: Narkowicz's fit of the ACES film curve, and gamma 2.
static float3 display(float3 x)
{
  x = max(x * 0.70f, 0.0f);
  return sqrt(clamp(x * (2.51f * x + 0.03f) / (x * (2.43f * x + 0.59f) + 0.14f), 0.0f, 1.0f));
}
