// Reading ahead, for lists that are in another order than what they point to.
//   BUILTINS   1: the compiler has clang's builtins for prefetching and streaming
#ifndef BUILTINS
#error "define BUILTINS as 0 or 1"
#endif
#if BUILTINS
#define PREFETCH_AS(pointer, writing, level) __builtin_prefetch((const void*)(uintptr_t)(pointer), writing, level)
#else
#define PREFETCH_AS(pointer, writing, level)
#endif
#define PREFETCH(pointer) PREFETCH_AS(pointer, 0, 3)
#define PREFETCH_TO_WRITE(pointer) PREFETCH_AS(pointer, 1, 3)
// Not into the first-level cache, which is full.
#define PREFETCH_FAR(pointer) PREFETCH_AS(pointer, 0, 2)
#define CACHE_LINE 64
