/* Closed loops and stop watches for tests and benchmarks on a host; no part of the kernel. */
#ifndef DBK_LAB_H
#define DBK_LAB_H

#include "dbk/dbk.h"

#ifdef __cplusplus
extern "C" {
#endif

typedef struct {
  uint64_t seed;
  int32_t steps, hold;     /* the adversary changes its mind every `hold` steps */
  double toward;           /* share of choices that go straight at the nearest row; the rest is bang-bang */
} dbk_adversary;

typedef struct {
  int64_t status[5];
  int64_t rows, iterations;
  double h_min;
} dbk_tally;

/* q integrates exactly (q += dt u in double); q_log (steps, n) holds the state after each step, u_log the control */
void dbk_closed_loop(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, const dbk_adversary *adversary,
                     double *q, double *q_log, double *u_log, int8_t *status_log, dbk_tally *tally);

/* mean seconds of processor time of one step over a recorded episode; cold: the warm start is dropped before every step */
double dbk_time_steps(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, const dbk_in *in, int32_t steps,
                      int32_t cold, dbk_out *out);

#ifdef __cplusplus
}
#endif
#endif
