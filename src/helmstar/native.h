/* What all kernels share. FAST: compiled for AVX2 too, and chosen when the library is loaded, where GCC and glibc can do that. */
#ifndef HELMSTAR_NATIVE_H
#define HELMSTAR_NATIVE_H

#include <stdint.h> /* and with it, on glibc, what says that it is */

#if defined(__x86_64__) && defined(__GLIBC__) && defined(__GNUC__) && !defined(__clang__)
#define FAST __attribute__((target_clones("avx2", "default")))
#else
#define FAST
#endif
#define INLINE static inline __attribute__((always_inline))

#endif
