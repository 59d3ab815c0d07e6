#include "common.h"
#include "splat.h"
#ifndef CHANNELS
#error "define CHANNELS"
#endif
#if VEC == 1
typedef REAL V;
typedef REAL VU;
#else
typedef JOIN(REAL, VEC) V;
typedef V __attribute__((aligned(REAL_BITS / 8))) VU;
#endif
#define LOAD(p) (*(global const VU*)(p))
#define STORE(v, p) (*(global VU*)(p) = (v))
#define BLOCKS ((CHANNELS + VEC - 1) / VEC)
#define AT(k) ((k) == BLOCKS - 1 ? CHANNELS - VEC : (k) * VEC)
#if VEC == 1
inline REAL total(V v) { return v; }
#elif VEC == 4
inline REAL total(V v) { REAL2 a = v.lo + v.hi; return a.x + a.y; }
#elif VEC == 8
inline REAL total(V v) { REAL4 b = v.lo + v.hi; REAL2 a = b.lo + b.hi; return a.x + a.y; }
#elif VEC == 16
inline REAL total(V v) { JOIN(REAL,8) c = v.lo + v.hi; REAL4 b = c.lo + c.hi; REAL2 a = b.lo + b.hi; return a.x + a.y; }
#endif

kernel void composite_tiles(
    const int height, const int width, const int tiles_y, const int tiles_x, const REAL min_transmittance,
    global const int* restrict tile_starts,   // [B * tiles + 1]
    global const record_t* restrict records,      // [E]
    global const REAL* restrict features,     // [P, C]
    global const REAL* restrict backgrounds,  // [B, C]
    global REAL* restrict image,              // [B, H, W, C] out
    global REAL* restrict coverage)           // [B, H, W] out
{
  const int t = get_global_id(0);
  const int tiles = tiles_x * tiles_y;
  const int b = t / tiles, ty = t % tiles / tiles_x, tx = t % tiles_x;
  const int left = tx * TILE, top = ty * TILE;
  const int right = min(left + TILE, width), bottom = min(top + TILE, height);
  V acc[PIXELS][BLOCKS];
  REAL trans[PIXELS];
  for (int p = 0; p < PIXELS; p++) {
    trans[p] = 1;
#pragma unroll
    for (int k = 0; k < BLOCKS; k++) acc[p][k] = 0;
  }
  const int begin = tile_starts[t], end = tile_starts[t + 1];
  for (int e = begin; e < end; e++) {
#ifdef AHEAD
    { int q = min(e + AHEAD, end - 1);  global const REAL* row = features + (size_t)records[q].id * CHANNELS;
#pragma unroll
      for (int k = 0; k < CHANNELS; k += 64 / sizeof(REAL)) __builtin_prefetch((const void*)(uintptr_t)(row + k), 0, 3); }
#endif
    global const record_t* point = records + e;
    global const REAL* row = features + (size_t)point->id * CHANNELS;
    V f[BLOCKS];
    V bad = 0;
#pragma unroll
    for (int k = 0; k < BLOCKS; k++) { f[k] = LOAD(row + AT(k)); bad += f[k] * 0; }
    if (total(bad) != 0) continue;
    const REAL u = point->u - left - (REAL)0.5, v = point->v - top - (REAL)0.5, r2 = point->r2, slope = point->slope, o = point->o;
    const int box = point->box;
    const int x0 = box & 255, x1 = box >> 8 & 255, y0 = box >> 16 & 255, y1 = (uint)box >> 24;
#define ONE(x,y) { \
        const REAL dx = (x) - u, dy = (y) - v; \
        const REAL d2 = dx * dx + dy * dy; \
        const int p = (y) * TILE + (x); \
        const REAL a = d2 < r2 ? o - slope * d2 : (REAL)0; \
        const REAL w = a * trans[p]; \
        trans[p] *= 1 - a; \
        _Pragma("unroll") for (int k = 0; k < BLOCKS; k++) acc[p][k] += w * f[k]; }
#ifdef QUAD
    if (x1 - x0 == 2 && y1 - y0 == 2) { ONE(x0,y0); ONE(x0+1,y0); ONE(x0,y0+1); ONE(x0+1,y0+1); continue;}
#endif
#ifdef QUAD4
    if (x1 - x0 == 4) { for (int y = y0; y < y1; y++) { ONE(x0,y); ONE(x0+1,y); ONE(x0+2,y); ONE(x0+3,y); } continue;}
#endif
    for (int y = y0; y < y1; y++)
      for (int x = x0; x < x1; x++) ONE(x,y)
  }
  global const REAL* back = backgrounds + (size_t)b * CHANNELS;
  V bg[BLOCKS];
#pragma unroll
  for (int k = 0; k < BLOCKS; k++) bg[k] = LOAD(back + AT(k));
  for (int y = top; y < bottom; y++)
    for (int x = left; x < right; x++) {
      const int p = (y - top) * TILE + (x - left);
      const size_t at = ((size_t)b * height + y) * width + x;
      coverage[at] = 1 - trans[p];
      global REAL* to = image + at * CHANNELS;
#pragma unroll
      for (int k = 0; k < BLOCKS; k++)
#ifdef STREAM
       __builtin_nontemporal_store(acc[p][k] + trans[p] * bg[k], (global V*)(to + AT(k)));
#else
       STORE(acc[p][k] + trans[p] * bg[k], to + AT(k));
#endif
    }
}
