// The two roofs that the splat kernels are held against: how fast a device copies, and how fast it multiplies and adds.
//
// copy_numbers    A work-group copies BLOCK vectors, its work-items side by side; on CPUs past the cache, as images.
// multiply_add    Each work-item keeps CHAINS vectors x = x m + c going, more than it takes to fill the pipelines.
//
//   BUILTINS   1: the compiler has clang's builtins for streaming
#ifndef BUILTINS
#error "define BUILTINS as 0 or 1"
#endif
#define BLOCK 1024
#define CHAINS 10

kernel void copy_numbers(
    global const float16* restrict from,  // [groups * BLOCK]
    global float16* restrict to)          // [groups * BLOCK] out
{
  const size_t begin = get_group_id(0) * (size_t)BLOCK;
  for (size_t i = begin + get_local_id(0); i < begin + BLOCK; i += get_local_size(0)) {
#if BUILTINS
    __builtin_nontemporal_store(from[i], to + i);
#else
    to[i] = from[i];
#endif
  }
}

kernel void multiply_add(
    const int rounds, const float m, const float c,
    global float* restrict sums)  // [work-items] out: keeps compilers from leaving it all out
{
  float16 chains[CHAINS];
  for (int k = 0; k < CHAINS; k++) chains[k] = k;
  for (int i = 0; i < rounds; i++) {
#pragma unroll
    for (int k = 0; k < CHAINS; k++) chains[k] = chains[k] * m + c;
  }
  float16 sum = 0;
  for (int k = 0; k < CHAINS; k++) sum += chains[k];
  sums[get_global_id(0)] = sum.s0 + sum.s5 + sum.sa + sum.sf;
}
