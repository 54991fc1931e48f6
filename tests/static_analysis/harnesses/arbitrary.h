/* Arbitrary bits for an abstract interpreter: every read of a volatile word is any value. */
#ifndef ARBITRARY_H
#define ARBITRARY_H

#include "dbk/dbk.h"

extern volatile uint32_t arbitrary_word;

/* a number with arbitrary bits, also NaN and infinite */
static inline dbk_real arbitrary_real(void) {
  union {
    uint32_t bits;
    float number;
  } any;
  any.bits = arbitrary_word;
  return any.number;
}

static inline void fill_arbitrary(dbk_real *x, int32_t count) {
  /*@ loop unroll 9; */
  for (int32_t k = 0; k < count; ++k) { x[k] = arbitrary_real(); }
}

#endif
