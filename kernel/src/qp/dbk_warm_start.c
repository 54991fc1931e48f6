/* Warm start of the QP. Row numbers change from step to step, so a constraint is stored by kind, i and j. */
#include "qp/dbk_warm_start.h"

#include "model/dbk_control_bounds.h"

/* stored rows that the current step does not contain are skipped */
int32_t dbk_warm_start_load(const dbk_model *model, const dbk_ctx *ctx, int32_t ids[DBK_QP_DIM]) {
  int32_t count = 0;
  for (int32_t w = 0; w < ctx->n_warm && count < DBK_QP_DIM; ++w) {
    const int32_t kind = ctx->warm[w][0], i = ctx->warm[w][1], j = ctx->warm[w][2];
    const int32_t joint = dbk_bounded(i, model->n - 1);
    if (kind == DBK_ROW_LOWER) {
      ids[count++] = joint;
    } else if (kind == DBK_ROW_UPPER) {
      ids[count++] = model->n + joint;
    } else if (kind == DBK_ROW_OBSTACLE || kind == DBK_ROW_SELF || kind == DBK_ROW_USER) {
      for (int32_t r = 0; r < ctx->rows.count; ++r) {
        if (ctx->rows.i[r] == i && ctx->rows.j[r] == j && ctx->rows.kind[r] == kind) {
          ids[count++] = 2 * model->n + r;
          break;
        }
      }
    }
  }
  return count;
}

/* the limit (DBK_LIMIT_...) that determines a control bound of joint k, with a tolerance of 0.1 % of the acceleration
 * step */
static int32_t limit_of(const dbk_model *model, const dbk_ctx *ctx, int32_t k, int32_t upper) {
  const dbk_real sign = upper ? (dbk_real)1 : (dbk_real)-1, dt = model->period;
  const dbk_real bound = sign * (upper ? ctx->upper[k] : ctx->lower[k]), last = sign * ctx->u_prev[k];
  const dbk_real step = model->a_max[k] * dt, tolerance = (dbk_real)1e-3 * step;
  const dbk_real jerk = last + sign * ctx->u_change[k] + model->j_max[k] * dt * dt;
  if (bound >= model->v_max[k] - tolerance) { return DBK_LIMIT_VELOCITY; }
  if (bound >= last + step - tolerance) { return DBK_LIMIT_ACCELERATION; }
  if (!(model->j_max[k] > (dbk_real)0)) { return DBK_LIMIT_POSITION; }
  if (dbk_abs(bound - jerk) <= tolerance) { return DBK_LIMIT_JERK; }
  /* the end of the acceleration before v_max */
  const dbk_real ramp = last + dbk_velocity_ramp(model, k, model->v_max[k] - last);
  return dbk_abs(bound - ramp) <= tolerance ? DBK_LIMIT_VELOCITY : DBK_LIMIT_POSITION;
}

/* kind, i, j, h and multiplier of active constraint `at` */
static void describe_active(const dbk_model *model, const dbk_ctx *ctx, int32_t at, dbk_active *out) {
  const int32_t id = ctx->solution.active[at], n = model->n;
  out->multiplier = ctx->solution.multiplier[at];
  if (id >= 2 * n) {
    const int32_t r = dbk_bounded(id - 2 * n, DBK_MAX_ROWS - 1);
    out->kind = ctx->rows.kind[r];
    out->i = ctx->rows.i[r];
    out->j = ctx->rows.j[r];
    out->h = ctx->rows.h[r];
  } else {
    out->kind = id < n ? DBK_ROW_LOWER : DBK_ROW_UPPER;
    out->i = dbk_bounded(id < n ? id : id - n, n - 1);
    out->j = limit_of(model, ctx, out->i, id >= n);
    out->h = (dbk_real)0;
  }
}

void dbk_warm_start_store(const dbk_model *model, dbk_ctx *ctx, dbk_out *out) {
  const int32_t count = ctx->solution.n_active;
  out->n_active = count;
  for (int32_t a = 0; a < count; ++a) { describe_active(model, ctx, a, &out->active[a]); }
  /* a Farkas certificate can have one member more than an active set; it is no warm start */
  ctx->n_warm = count < DBK_QP_DIM ? count : 0;
  for (int32_t a = 0; a < ctx->n_warm; ++a) {
    ctx->warm[a][0] = out->active[a].kind;
    ctx->warm[a][1] = out->active[a].i;
    ctx->warm[a][2] = out->active[a].j;
  }
}
