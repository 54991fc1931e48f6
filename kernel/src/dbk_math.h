/* Scalar arithmetic and reductions over SIMD lanes. All comparisons are written such that NaN selects the safe
 * branch. */
#ifndef DBK_MATH_H
#define DBK_MATH_H

#include "dbk/dbk.h"

#if DBK_MAX_OBSTACLES % DBK_LANES != 0 || DBK_MAX_ROWS % DBK_LANES != 0
#error "DBK_MAX_OBSTACLES and DBK_MAX_ROWS are multiples of DBK_LANES"
#endif

/* a small function that every build inlines, also one for small code: its call costs more than its body */
#ifdef __GNUC__
#define DBK_INLINED static inline __attribute__((always_inline))
#else
#define DBK_INLINED static inline
#endif

/* A build for a host can define this macro as __attribute__((target_clones(...))). The compiler then emits each marked
 * function for several instruction sets, and the loader selects the fastest one that the processor supports. The order
 * and the rounding of all operations are the same in every clone, so the results are bit-identical. */
#ifndef DBK_SIMD_CLONES
#define DBK_SIMD_CLONES
#endif

static inline dbk_real dbk_abs(dbk_real x) { return x < (dbk_real)0 ? -x : x; }
static inline dbk_real dbk_min(dbk_real a, dbk_real b) { return a < b ? a : b; }
static inline dbk_real dbk_max(dbk_real a, dbk_real b) { return a > b ? a : b; }

/* `value` within 0..most. Counts and indices are within their bounds anyway; static analysis reads it from here */
DBK_INLINED int32_t dbk_bounded(int32_t value, int32_t most) { return value < 0 ? 0 : (value > most ? most : value); }

/* minimum and maximum over the lanes and `start` */
static inline dbk_real dbk_min_lanes(const dbk_real lane[DBK_LANES], dbk_real start) {
  for (int32_t l = 0; l < DBK_LANES; ++l) { start = dbk_min(start, lane[l]); }
  return start;
}

static inline dbk_real dbk_max_lanes(const dbk_real lane[DBK_LANES], dbk_real start) {
  for (int32_t l = 0; l < DBK_LANES; ++l) { start = dbk_max(start, lane[l]); }
  return start;
}

/* zeros in the entries first..end-1, a multiple of DBK_LANES; compilers replace a plain loop by a call of memset */
static inline void dbk_fill_zero(dbk_real *to, int32_t first, int32_t end) {
  for (int32_t base = first; base < end; base += DBK_LANES) {
    for (int32_t l = 0; l < DBK_LANES; ++l) { to[base + l] = (dbk_real)0; }
  }
}

static inline dbk_real dbk_clamp(dbk_real x, dbk_real lower, dbk_real upper) {
  if (x > upper) { return upper; }
  return x >= lower ? x : lower; /* NaN becomes the lower bound */
}

static inline dbk_real dbk_sqrt(dbk_real x) {
#ifdef DBK_DOUBLE
  return __builtin_sqrt(x);
#else
  return __builtin_sqrtf(x);
#endif
}

/* index of the lowest set bit; `bits` must not be 0 */
static inline int32_t dbk_lowest_bit(uint32_t bits) { return (int32_t)__builtin_ctz(bits); }

static inline dbk_real dbk_length(dbk_real x, dbk_real y, dbk_real z) { return dbk_sqrt(x * x + y * y + z * z); }

#ifdef DBK_DOUBLE
#define DBK_NAN __builtin_nan("")
#else
#define DBK_NAN __builtin_nanf("")
#endif

static inline int32_t dbk_finite(dbk_real x) {
  const dbk_real difference = x - x; /* NaN if x is NaN or infinite */
  return difference == (dbk_real)0;
}

static inline int32_t dbk_all_finite(const dbk_real *x, int32_t count) {
  int32_t finite = 1;
  for (int32_t i = 0; i < count; ++i) { finite &= dbk_finite(x[i]); }
  return finite;
}

#endif
