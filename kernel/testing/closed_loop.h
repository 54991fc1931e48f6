/* Closed-loop simulation and timing on a host, for tests and benchmarks; not a part of the kernel. */
#ifndef DBK_CLOSED_LOOP_H
#define DBK_CLOSED_LOOP_H

#include "dbk/dbk.h"

#ifdef __cplusplus
extern "C" {
#endif

/* an adversarial nominal control: it changes every `hold` steps; the share `toward` of its choices moves at full speed
 * toward a row, and the rest are bang-bang controls */
typedef struct {
  uint64_t seed;
  int32_t steps, hold;
  double toward;
} dbk_adversary;

typedef struct {
  int64_t status[5]; /* steps by status */
  int64_t rows, iterations;
  double h_min;
} dbk_step_counts;

/* simulates q += dt u in double precision; q_log (steps, n) receives the state after each step, u_log the control */
void dbk_closed_loop(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, const dbk_adversary *adversary,
                     double *q, double *q_log, double *u_log, int8_t *status_log, dbk_step_counts *counts);

/* mean processor time of one step over a recorded episode [s]; `cold`: without the warm start */
double dbk_time_steps(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, const dbk_in *in, int32_t steps,
                      int32_t cold, dbk_out *out);

#ifdef __cplusplus
}
#endif
#endif
