/* Closed-loop simulation and timing on a host; see closed_loop.h. */
#define _POSIX_C_SOURCE 199309L
#include "closed_loop.h"

#include <time.h>

#include "random.h"

/* chooses a bang-bang control, or full speed against the gradient of the row with the smallest h or of a random row */
static void choose(const dbk_model *model, const dbk_ctx *ctx, const dbk_adversary *a, uint64_t *random, dbk_in *in) {
  int32_t row = -1;
  for (int32_t r = 0; r < ctx->rows.count; ++r) {
    if (row < 0 || ctx->rows.h[r] < ctx->rows.h[row]) { row = r; }
  }
  if (ctx->rows.count > 0 && dbk_random_uniform(random) < 0.3) {
    row = (int32_t)(dbk_random_uniform(random) * (double)ctx->rows.count);
  }
  const int32_t at_row = row >= 0 && dbk_random_uniform(random) < a->toward;
  for (int32_t k = 0; k < model->n; ++k) {
    const double coin = dbk_random_uniform(random);
    double sign = coin < 0.5 ? -1.0 : 1.0;
    if (at_row) { sign = ctx->rows.a[k][row] > (dbk_real)0 ? -1.0 : 1.0; }
    in->u_nom[k] = (dbk_real)sign * model->v_max[k];
  }
}

void dbk_closed_loop(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, const dbk_adversary *adversary,
                     double *q, double *q_log, double *u_log, int8_t *status_log, dbk_step_counts *counts) {
  uint64_t random = adversary->seed;
  dbk_in in = {.opening = (dbk_real)0};
  dbk_out out;
  ctx->rows.count = 0;
  for (int32_t t = 0; t < adversary->steps; ++t) {
    for (int32_t k = 0; k < model->n; ++k) { in.q[k] = (dbk_real)q[k]; }
    if (t % adversary->hold == 0) { choose(model, ctx, adversary, &random, &in); }
    const dbk_status status = dbk_step(model, scene, ctx, &in, &out);
    ++counts->status[status];
    counts->rows += out.n_rows;
    counts->iterations += out.iterations;
    if ((double)out.h_min < counts->h_min) { counts->h_min = (double)out.h_min; }
    for (int32_t k = 0; k < model->n; ++k) {
      q[k] += (double)model->period * (double)out.u[k];
      q_log[(int64_t)t * model->n + k] = q[k];
      u_log[(int64_t)t * model->n + k] = (double)out.u[k];
    }
    status_log[t] = (int8_t)status;
  }
}

double dbk_time_steps(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, const dbk_in *in, int32_t steps,
                      int32_t cold, dbk_out *out) {
  struct timespec begin, end;
  clock_gettime(CLOCK_THREAD_CPUTIME_ID, &begin);
  for (int32_t t = 0; t < steps; ++t) {
    if (cold) { ctx->n_warm = 0; }
    (void)dbk_step(model, scene, ctx, &in[t], out);
  }
  clock_gettime(CLOCK_THREAD_CPUTIME_ID, &end);
  return ((double)(end.tv_sec - begin.tv_sec) + 1e-9 * (double)(end.tv_nsec - begin.tv_nsec)) / (double)steps;
}
