/* Random numbers for tests: splitmix64, so that every run is reproducible from its seed on every machine. */
#ifndef DBK_RANDOM_H
#define DBK_RANDOM_H

#include <math.h>
#include <stdint.h>

/* uniform in [0, 1) */
static inline double dbk_random_uniform(uint64_t *state) {
  uint64_t z = (*state += 0x9E3779B97F4A7C15u);
  z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9u;
  z = (z ^ (z >> 27)) * 0x94D049BB133111EBu;
  return (double)((z ^ (z >> 31)) >> 11) * (1.0 / 9007199254740992.0);
}

/* uniform in [-1, 1) */
static inline double dbk_random_symmetric(uint64_t *state) { return 2.0 * dbk_random_uniform(state) - 1.0; }

/* uniform on the unit sphere, by rejection from the cube */
static inline void dbk_random_direction(uint64_t *state, double out[3]) {
  double square = 0.0;
  do {
    for (int i = 0; i < 3; ++i) { out[i] = dbk_random_symmetric(state); }
    square = out[0] * out[0] + out[1] * out[1] + out[2] * out[2];
  } while (square > 1.0 || square < 1e-6);
  for (int i = 0; i < 3; ++i) { out[i] /= sqrt(square); }
}

#endif
