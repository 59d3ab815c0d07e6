// What every kernel shares: the scalar type and its helpers.
//   REAL      float or double, the type of every coordinate, feature and gradient
//   REAL_BITS 32 or 64, its size
//   NEAR      nearest z-depth that makes a fragment, metres
#ifndef REAL
#error "define REAL as float or double"
#endif
#ifndef REAL_BITS
#error "define REAL_BITS as 32 or 64"
#endif
#ifndef NEAR
#error "define NEAR, the nearest depth in metres"
#endif

#if REAL_BITS == 64
#pragma OPENCL EXTENSION cl_khr_fp64 : enable
#define AS_KEY as_ulong
#define SMALLEST DBL_MIN
typedef ulong key_bits;
#else
#define AS_KEY as_uint
#define SMALLEST FLT_MIN
typedef uint key_bits;
#endif

#define JOIN_(a, b) a##b
#define JOIN(a, b) JOIN_(a, b)
#define REAL2 JOIN(REAL, 2)
#define REAL4 JOIN(REAL, 4)

// A type that the host knows too has the size that the host takes it to have; else this does not compile.
#define ASSERT_SIZE(type, bytes) typedef char JOIN(type, _has_the_hosts_size)[sizeof(type) == (bytes) ? 1 : -1]
ASSERT_SIZE(REAL, REAL_BITS / 8);
