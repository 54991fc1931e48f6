/* Relaxation: the least violation of the rows if no control satisfies all of them.
 *
 * The reference is the maximum admissible braking: no pair closes faster than under braking, independent of the motion
 * of the obstacles. Within this limit, the ranks are processed from the highest to the lowest. For each rank a QP with
 * one slack minimises the largest violation, subject to the values granted to higher ranks. A rank with moving
 * obstacles is processed twice: first as if all obstacles were static, so that the robot does not move toward any of
 * them (passive safety), then with their velocities, so that the robot moves out of their way. The speed limits are
 * kept: braking satisfies their cuts, which therefore keep their right sides.
 */
#include "qp/dbk_relaxation.h"

#include "qp/dbk_qp.h"
#include "speed/dbk_speed_limit.h"

/* [1/(m/s)] coefficient of the slack: small, so that violations are expensive */
#define SLACK_WEIGHT ((dbk_real)1e-3)
/* fraction of the control range that is available for stopping in every case, also at a corner of the control bounds */
#define STOPPING_SHARE ((dbk_real)0.05)

/* targets of all rows */
typedef struct {
  dbk_real full[DBK_MAX_ROWS];    /* right side, at most the maximum of a'u over the control bounds */
  dbk_real passive[DBK_MAX_ROWS]; /* right side if the obstacle were static */
  dbk_real floor[DBK_MAX_ROWS];   /* lower limit of a'u; for pairs the value under braking */
  int32_t level[DBK_MAX_ROWS];    /* rank; 0 for a pair that braking satisfies */
  int32_t lowest;                 /* largest level */
  int32_t moving;                 /* bit r: a row of level r belongs to a moving obstacle */
} row_targets;

/* The right side of a row of an obstacle that approaches at speed s, without the part that the obstacle causes: the
 * robot moves toward it no faster than its row permits, and no faster than v = a h / s, from which it can stop before the
 * obstacle arrives. */
static dbk_real passive_target(const dbk_model *model, const dbk_scene *scene, const dbk_rows *rows, int32_t r,
                               dbk_real range, dbk_real target) {
  const dbk_obstacle_capsules *c = &scene->capsules;
  const int32_t o = dbk_bounded(rows->j[r], DBK_OBSTACLE_CAPACITY - 1);
  const dbk_real drift =
      rows->nx[r] * c->vx[o] + rows->ny[r] * c->vy[o] + rows->nz[r] * c->vz[o] + c->velocity_error[o];
  if (rows->h[r] <= (dbk_real)0) { return dbk_min(target, (dbk_real)0); }
  const dbk_real at_rest = rows->b[r] - drift / rows->norm[r];
  if (drift <= (dbk_real)0) { return dbk_min(target, at_rest); }
  const dbk_real arrival = rows->h[r] / (drift * model->period); /* [periods] */
  return dbk_min(target, dbk_max(at_rest, -STOPPING_SHARE * range * arrival));
}

static void set_targets(const dbk_model *model, const dbk_scene *scene, const dbk_ctx *ctx, const dbk_real *brake,
                        row_targets *t) {
  const dbk_rows *rows = &ctx->rows;
  t->lowest = t->moving = 0;
  for (int32_t r = 0; r < rows->count; ++r) {
    /* a'u under braking, and its maximum and minimum over the control bounds */
    dbk_real at_brake = (dbk_real)0, best = (dbk_real)0, worst = (dbk_real)0;
    for (int32_t k = 0; k < model->n; ++k) {
      const dbk_real a = rows->a[k][r];
      at_brake += a * brake[k];
      best += a > (dbk_real)0 ? a * ctx->upper[k] : a * ctx->lower[k];
      worst += a > (dbk_real)0 ? a * ctx->lower[k] : a * ctx->upper[k];
    }
    const dbk_real range = (dbk_real)0.5 * (best - worst);
    t->full[r] = dbk_min(rows->b[r], best);
    const int32_t pair = rows->rank[r] <= DBK_RANK_OBSTACLE;
    t->passive[r] = rows->moving[r] ? passive_target(model, scene, rows, r, range, t->full[r]) : t->full[r];
    t->floor[r] = pair ? dbk_min(t->passive[r], at_brake - DBK_RANK_TOL) : (dbk_real)-1e9;
    t->level[r] = pair && at_brake >= t->full[r] ? 0 : dbk_bounded(rows->rank[r], DBK_RANK_TASK);
    t->lowest = t->level[r] > t->lowest ? t->level[r] : t->lowest;
    if (rows->moving[r]) { t->moving |= 1 << t->level[r]; }
  }
}

/* appends a copy of row r with right side `target` and a slack */
static void append_soft_row(dbk_rows *rows, int32_t n, int32_t r, dbk_real target) {
  const int32_t at = rows->count++;
  for (int32_t k = 0; k < n; ++k) { rows->a[k][at] = rows->a[k][r]; }
  rows->b[at] = target;
  rows->soft[at] = dbk_min((dbk_real)1, SLACK_WEIGHT / rows->norm[r]);
}

/* fills the last SIMD vector with rows that never bind */
static void pad_rows(dbk_rows *rows, int32_t n) {
  for (int32_t r = rows->count; r < DBK_MAX_ROWS && r % DBK_LANES != 0; ++r) {
    for (int32_t k = 0; k < n; ++k) { rows->a[k][r] = (dbk_real)0; }
    rows->b[r] = (dbk_real)-1e9;
    rows->soft[r] = (dbk_real)0;
  }
}

/* moves the rows from `first` on, which are new cuts, to row `count`; they are kept like rows that braking satisfies */
static void keep_cuts(dbk_rows *rows, int32_t n, row_targets *t, int32_t first, int32_t count) {
  const int32_t end = rows->count;
  rows->count = count;
  for (int32_t r = first; r < end && rows->count < DBK_MAX_ROWS; ++r) {
    const int32_t to = rows->count++;
    for (int32_t k = 0; k < n; ++k) { rows->a[k][to] = rows->a[k][r]; }
    rows->b[to] = rows->b[r];
    rows->soft[to] = (dbk_real)0;
    rows->norm[to] = rows->norm[r];
    rows->h[to] = rows->h[r];
    rows->kind[to] = rows->kind[r];
    rows->i[to] = rows->i[r];
    rows->j[to] = rows->j[r];
    rows->moving[to] = rows->clip[to] = rows->rank[to] = 0;
    t->level[to] = 0;
  }
}

/* Minimises the largest violation [m/s] of the right sides `target` of a rank with one slack, and raises the right
 * sides of these rows to the granted values. u is the control closest to braking that attains the minimum. Returns the
 * violation, or a negative value if the QP failed. */
static dbk_real minimise_violation(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, row_targets *t,
                                   const dbk_real *target, int32_t rank, const dbk_real *brake, dbk_real *u) {
  dbk_rows *rows = &ctx->rows;
  const int32_t n = model->n, count = rows->count;
  /* hard rows with the values granted so far, and a soft copy of each row of the rank */
  for (int32_t r = 0; r < count && rows->count < DBK_MAX_ROWS; ++r) {
    if (t->level[r] == rank) { append_soft_row(rows, n, r, target[r]); }
  }
  if (rows->count == count) { return (dbk_real)0; }
  pad_rows(rows, n);
  const int32_t with_copies = rows->count;
  int32_t result = 0, cut = 1;
  for (int32_t tries = 0; cut > 0 && tries < DBK_SPEED_ROUNDS; ++tries) {
    result = dbk_qp(rows, n, model->scale, ctx->lower, ctx->upper, brake, 1, (dbk_real)0, 0, 0, &ctx->solution);
    cut = result == 0 ? dbk_cut_speed(model, scene, ctx, ctx->solution.u) : 0;
  }
  keep_cuts(rows, n, t, with_copies, count);
  pad_rows(rows, n);
  if (result != 0) { return (dbk_real)-1; }
  /* grant the rows of the rank the attained values */
  const dbk_real slack = dbk_max(ctx->solution.slack, (dbk_real)0);
  for (int32_t r = 0; r < count; ++r) {
    if (t->level[r] == rank) {
      const dbk_real violation = dbk_min((dbk_real)1, SLACK_WEIGHT / rows->norm[r]) * slack + DBK_RANK_TOL;
      rows->b[r] = dbk_max(rows->b[r], target[r] - violation);
    }
  }
  for (int32_t k = 0; k < n; ++k) { u[k] = dbk_clamp(ctx->solution.u[k], ctx->lower[k], ctx->upper[k]); }
  if (cut != 0) { dbk_slow_down(model, scene, ctx, brake, u); }
  return slack * SLACK_WEIGHT;
}

int32_t dbk_relax(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, const dbk_real brake[DBK_MAX_DOF],
                  dbk_real u[DBK_MAX_DOF]) {
  dbk_rows *rows = &ctx->rows;
  row_targets t;
  int32_t relaxed = 0;
  set_targets(model, scene, ctx, brake, &t);
  /* start: braking, with every row at its floor */
  for (int32_t k = 0; k < model->n; ++k) { u[k] = brake[k]; }
  for (int32_t r = 0; r < rows->count; ++r) {
    rows->b[r] = t.floor[r];
    rows->soft[r] = (dbk_real)0;
  }
  for (int32_t rank = DBK_RANK_BODY; rank <= t.lowest; ++rank) {
    /* passive safety first */
    if (t.moving >> rank & 1 && minimise_violation(model, scene, ctx, &t, t.passive, rank, brake, u) < (dbk_real)0) { break; }
    const dbk_real violation = minimise_violation(model, scene, ctx, &t, t.full, rank, brake, u);
    if (violation < (dbk_real)0) { break; }
    if (violation > DBK_VIOLATION_TOL) { relaxed |= 1 << rank; }
  }
  return relaxed;
}
