// A row of CHANNELS numbers as BLOCKS vectors of VECTOR lanes. Where VECTOR does not divide CHANNELS the last
// vector overlaps the one before by OVERLAP lanes, so that every access stays inside the row and is a whole vector.
//   CHANNELS   numbers per row
//   VECTOR     1, 4, 8 or 16 lanes, at most CHANNELS
//   STREAM     1: rows are whole, aligned cache lines and VECTOR divides them; write them past the cache
#ifndef CHANNELS
#error "define CHANNELS, the number of features per point"
#endif
#ifndef VECTOR
#error "define VECTOR, the lanes of a vector of channels"
#endif
#ifndef STREAM
#error "define STREAM as 0 or 1"
#endif
#if VECTOR > CHANNELS || (VECTOR != 1 && VECTOR != 4 && VECTOR != 8 && VECTOR != 16)
#error "VECTOR must be 1, 4, 8 or 16, and at most CHANNELS"
#endif
#define BLOCKS ((CHANNELS + VECTOR - 1) / VECTOR)
#define BLOCK_START(k) ((k) == BLOCKS - 1 ? CHANNELS - VECTOR : (k) * VECTOR)
#define OVERLAP (BLOCKS * VECTOR - CHANNELS)

#if VECTOR == 1
typedef REAL vector_t;
typedef REAL loose_vector_t;
inline REAL sum_lanes(vector_t v) { return v; }
#else
typedef JOIN(REAL, VECTOR) vector_t;
typedef vector_t __attribute__((aligned(REAL_BITS / 8))) loose_vector_t;  // rows are aligned to their numbers only
#if VECTOR == 4
inline REAL sum_lanes(vector_t v) {
  const REAL2 first = v.lo + v.hi;
  return first.x + first.y;
}
#elif VECTOR == 8
inline REAL sum_lanes(vector_t v) {
  const REAL4 first = v.lo + v.hi;
  const REAL2 second = first.lo + first.hi;
  return second.x + second.y;
}
#else
inline REAL sum_lanes(vector_t v) {
  const JOIN(REAL, 8) first = v.lo + v.hi;
  const REAL4 second = first.lo + first.hi;
  const REAL2 third = second.lo + second.hi;
  return third.x + third.y;
}
#endif
#endif

inline REAL sum_of_four(REAL4 v) { return (v.x + v.y) + (v.z + v.w); }

#if VECTOR == 1
inline REAL4 sum_lanes_of_four(const vector_t* v) { return (REAL4)(v[0], v[1], v[2], v[3]); }
#else
#if VECTOR == 4
#define TO_FOUR(v) (v)
#elif VECTOR == 8
#define TO_FOUR(v) ((v).lo + (v).hi)
#else
#define TO_FOUR(v) (((v).lo.lo + (v).lo.hi) + ((v).hi.lo + (v).hi.hi))
#endif
// The four sums of the lanes of four vectors, by transposing.
inline REAL4 sum_lanes_of_four(const vector_t* v) {
  const REAL4 a = TO_FOUR(v[0]), b = TO_FOUR(v[1]), c = TO_FOUR(v[2]), d = TO_FOUR(v[3]);
  const REAL4 ab = (REAL4)(a.lo, b.lo) + (REAL4)(a.hi, b.hi), cd = (REAL4)(c.lo, d.lo) + (REAL4)(c.hi, d.hi);
  return (REAL4)(ab.even, cd.even) + (REAL4)(ab.odd, cd.odd);
}
#endif

// Lane j of vector i becomes lane i of vector j: each round of shuffles interleaves vectors half of them apart.
inline void transpose(vector_t* vectors) {
#if VECTOR > 1
#pragma unroll
  for (int rounds = VECTOR; rounds > 1; rounds /= 2) {
    vector_t next[VECTOR];
#pragma unroll
    for (int i = 0; i < VECTOR / 2; i++) {
      next[2 * i].even = vectors[i].lo;
      next[2 * i].odd = vectors[i + VECTOR / 2].lo;
      next[2 * i + 1].even = vectors[i].hi;
      next[2 * i + 1].odd = vectors[i + VECTOR / 2].hi;
    }
#pragma unroll
    for (int i = 0; i < VECTOR; i++) vectors[i] = next[i];
  }
#endif
}

inline void copy_row(global const REAL* row, vector_t* blocks) {
#pragma unroll
  for (int k = 0; k < BLOCKS; k++) blocks[k] = *(global const loose_vector_t*)(row + BLOCK_START(k));
}

// Read a row; false where one of its numbers is NaN or infinite (x * 0 is 0 only for finite x).
inline bool load_row(global const REAL* row, vector_t* blocks) {
  copy_row(row, blocks);
  vector_t zero = 0;
#pragma unroll
  for (int k = 0; k < BLOCKS; k++) zero += blocks[k] * 0;
  return sum_lanes(zero) == 0;
}

// Write blocks to a row, the overlapping one first: the lanes that it shares come right from the one before.
inline void store_row(const vector_t* blocks, global REAL* row) {
#pragma unroll
  for (int k = BLOCKS - 1; k >= 0; k--) *(global loose_vector_t*)(row + BLOCK_START(k)) = blocks[k];
}

inline void stream_row(const vector_t* blocks, global REAL* row) {
#if STREAM
#pragma unroll
  for (int k = 0; k < BLOCKS; k++) __builtin_nontemporal_store(blocks[k], (global vector_t*)(row + BLOCK_START(k)));
#else
  store_row(blocks, row);
#endif
}

inline void add_row(const vector_t* blocks, global REAL* row) {
  vector_t sums[BLOCKS];
#pragma unroll
  for (int k = 0; k < BLOCKS; k++) sums[k] = *(global const loose_vector_t*)(row + BLOCK_START(k)) + blocks[k];
  store_row(sums, row);
}

inline void clear_row(global REAL* row) {
  vector_t zeros[BLOCKS];
#pragma unroll
  for (int k = 0; k < BLOCKS; k++) zeros[k] = 0;
  stream_row(zeros, row);
}
