// Hashes, noise and box filters: the raw material of every texture. Integer arithmetic makes them equal on all devices.

static uint hash(uint a, uint b, uint c)
{
  uint h = a * 0x8da6b343u ^ b * 0xd8163841u ^ c * 0xcb1ab31fu;  // lowbias32 finishes
  h = (h ^ h >> 16) * 0x7feb352du;
  h = (h ^ h >> 15) * 0x846ca68bu;
  return h ^ h >> 16;
}

// Uniform in [0, 1).
static float random(int a, int b, uint seed) { return (hash(a, b, seed) >> 8) * 0x1p-24f; }

// Value noise in [0, 1): random numbers on the integer grid, smoothly interpolated.
static float noise2(float2 p, uint seed)
{
  const float2 low = floor(p), f = p - low, w = f * f * (3 - 2 * f);
  const int x = (int)low.x, y = (int)low.y;
  const float top = mix(random(x, y, seed), random(x + 1, y, seed), w.x);
  const float bottom = mix(random(x, y + 1, seed), random(x + 1, y + 1, seed), w.x);
  return mix(top, bottom, w.y);
}

static float noise3(float3 p, uint seed)
{
  const float low = floor(p.z), f = p.z - low;
  const uint layer = seed + (uint)(int)low * 0x9e3779b9u;
  return mix(noise2(p.xy, layer), noise2(p.xy, layer + 0x9e3779b9u), f * f * (3 - 2 * f));
}

// How much of a detail of this size survives a pixel's footprint; both in metres.
static float visible(float size, float footprint) { return clamp(size / footprint - 0.5f, 0.0f, 1.0f); }

// Noise in [-1, 1] whose spots have this size in metres, faded where pixels are too coarse to show it.
static float grain(float2 p, float size, float footprint, uint seed)
{
  const float share = visible(size, footprint);
  return share > 0 ? share * (2 * noise2(p / size, seed) - 1) : 0;
}

// Share of [x - width / 2, x + width / 2] that lies in [low, high].
static float band(float x, float low, float high, float width)
{
  const float reach = 0.5f * width;
  return max(0.0f, min(x + reach, high) - max(x - reach, low)) / width;
}

static float centred(float x, float half_size, float width) { return band(x, -half_size, half_size, width); }

// x modulo the period, in [-period / 2, period / 2).
static float fold(float x, float period) { return x - period * floor(x / period + 0.5f); }

// Share covered by lines of this width, one each period.
static float lines(float x, float period, float line, float width)
{
  return width < period ? centred(fold(x, period), 0.5f * line, width) : line / period;
}
