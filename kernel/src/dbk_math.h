/* Small arithmetic used everywhere. Comparisons are written so that NaN takes the refusing branch. */
#ifndef DBK_MATH_H
#define DBK_MATH_H

#include "dbk/dbk.h"

#if DBK_MAX_OBSTACLES % DBK_LANES != 0 || DBK_MAX_ROWS % DBK_LANES != 0
#error "DBK_MAX_OBSTACLES and DBK_MAX_ROWS are multiples of DBK_LANES"
#endif

/* A host's build may have the loops over pairs and rows compiled twice, for the vectors of its newer processors too, the
 * faster being chosen when the program is loaded. Order and rounding of every operation, hence every bit, stay the same. */
#ifndef DBK_WIDE
#define DBK_WIDE
#endif

static inline dbk_real dbk_abs(dbk_real x) { return x < (dbk_real)0 ? -x : x; }
static inline dbk_real dbk_min(dbk_real a, dbk_real b) { return a < b ? a : b; }
static inline dbk_real dbk_max(dbk_real a, dbk_real b) { return a > b ? a : b; }

/* the least and the greatest of one number for each lane, or `start` */
static inline dbk_real dbk_least(const dbk_real lane[DBK_LANES], dbk_real start) {
  for (int32_t l = 0; l < DBK_LANES; ++l) { start = dbk_min(start, lane[l]); }
  return start;
}

static inline dbk_real dbk_greatest(const dbk_real lane[DBK_LANES], dbk_real start) {
  for (int32_t l = 0; l < DBK_LANES; ++l) { start = dbk_max(start, lane[l]); }
  return start;
}

/* zeros, a vector at a time: as a plain loop, compilers make it a call */
static inline void dbk_clear(dbk_real *to, int32_t count) {
  for (int32_t base = 0; base < count; base += DBK_LANES) {
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

/* the number of the lowest bit that is set, of some */
static inline int32_t dbk_lowest_bit(uint32_t bits) { return (int32_t)__builtin_ctz(bits); }

static inline dbk_real dbk_length(dbk_real x, dbk_real y, dbk_real z) { return dbk_sqrt(x * x + y * y + z * z); }

#ifdef DBK_DOUBLE
#define DBK_UNKNOWN __builtin_nan("")
#else
#define DBK_UNKNOWN __builtin_nanf("")
#endif

static inline int32_t dbk_finite(dbk_real x) {
  const dbk_real none = x - x; /* NaN for NaN and for infinities */
  return none == (dbk_real)0;
}

static inline int32_t dbk_all_finite(const dbk_real *x, int32_t count) {
  int32_t good = 1;
  for (int32_t i = 0; i < count; ++i) { good &= dbk_finite(x[i]); }
  return good;
}

#endif
