// Reading ahead, for lists that are in another order than what they point to.
//   BUILTINS   1: the compiler has clang's builtins for prefetching and streaming
#ifndef BUILTINS
#error "define BUILTINS as 0 or 1"
#endif
#if BUILTINS
#define PREFETCH(pointer) __builtin_prefetch((const void*)(uintptr_t)(pointer), 0, 3)
#else
#define PREFETCH(pointer)
#endif
#define CACHE_LINE 64
