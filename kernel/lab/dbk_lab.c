#define _POSIX_C_SOURCE 199309L
#include "dbk_lab.h"

#include <time.h>

static double chance(uint64_t *state) {
  uint64_t z = (*state += 0x9E3779B97F4A7C15u); /* splitmix64 */
  z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9u;
  z = (z ^ (z >> 27)) * 0x94D049BB133111EBu;
  return (double)((z ^ (z >> 31)) >> 11) * (1.0 / 9007199254740992.0);
}

/* bang-bang, or down the gradient of the row with the smallest h */
static void choose(const dbk_model *model, const dbk_ctx *ctx, const dbk_adversary *a, uint64_t *state, dbk_in *in) {
  int32_t row = -1;
  for (int32_t r = 0; r < ctx->rows.count; ++r) {
    if (row < 0 || ctx->rows.h[r] < ctx->rows.h[row]) { row = r; }
  }
  if (ctx->rows.count > 0 && chance(state) < 0.3) { row = (int32_t)(chance(state) * (double)ctx->rows.count); }
  const int32_t at_row = row >= 0 && chance(state) < a->toward;
  for (int32_t k = 0; k < model->n; ++k) {
    const double coin = chance(state);
    double sign = coin < 0.5 ? -1.0 : 1.0;
    if (at_row) { sign = ctx->rows.a[k][row] > (dbk_real)0 ? -1.0 : 1.0; }
    in->u_nom[k] = (dbk_real)sign * model->v_max[k];
  }
}

void dbk_closed_loop(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, const dbk_adversary *adversary,
                     double *q, double *q_log, double *u_log, int8_t *status_log, dbk_tally *tally) {
  uint64_t state = adversary->seed;
  dbk_in in = {.opening = (dbk_real)0};
  dbk_out out;
  ctx->rows.count = 0;
  for (int32_t t = 0; t < adversary->steps; ++t) {
    for (int32_t k = 0; k < model->n; ++k) { in.q[k] = (dbk_real)q[k]; }
    if (t % adversary->hold == 0) { choose(model, ctx, adversary, &state, &in); }
    const dbk_status status = dbk_step(model, scene, ctx, &in, &out);
    ++tally->status[status];
    tally->rows += out.n_rows;
    tally->iterations += out.iterations;
    if ((double)out.h_min < tally->h_min) { tally->h_min = (double)out.h_min; }
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
