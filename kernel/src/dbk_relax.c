/* Relaxation: what to do when no control meets all rows. */
#include "dbk_math.h"

#define SOFT ((dbk_real)1e-3) /* [1/(m/s)] weight of the shared slack: small, so that violating a row is expensive */
#define SPARE ((dbk_real)0.05) /* share of what the box can change that surely helps to stop, also in a corner */

/* what relaxation knows of the rows: what each asks for (never more than the box can give), what it gets at least (pairs:
 * what braking gives them), and its rank, 0 for a pair that braking meets. `passive` is what a pair with something that
 * moves would ask for if that stood still: not to go toward it */
typedef struct {
  dbk_real want[DBK_MAX_ROWS], passive[DBK_MAX_ROWS], floor[DBK_MAX_ROWS];
  int32_t level[DBK_MAX_ROWS], lowest, moving;
} grades;

/* the robot's own part of a row about something that comes at speed s: never toward it faster than alpha h, nor faster
 * than it can surely be at rest when that arrives, v <= a h / s */
static dbk_real passive_part(const dbk_model *model, const dbk_scene *scene, const dbk_rows *rows, int32_t r,
                             dbk_real change, dbk_real want) {
  const dbk_covers *c = &scene->covers;
  const int32_t o = rows->j[r];
  const dbk_real drift = rows->nx[r] * c->vx[o] + rows->ny[r] * c->vy[o] + rows->nz[r] * c->vz[o] + c->error[o];
  if (rows->h[r] <= (dbk_real)0) { return dbk_min(want, (dbk_real)0); }
  const dbk_real still = rows->b[r] - drift / rows->norm[r];
  if (drift <= (dbk_real)0) { return dbk_min(want, still); }
  const dbk_real arrival = rows->h[r] / (drift * model->period);
  return dbk_min(want, dbk_max(still, -SPARE * change * arrival));
}

static void grade(const dbk_model *model, const dbk_scene *scene, const dbk_ctx *ctx, const dbk_real *brake, grades *g) {
  const dbk_rows *rows = &ctx->rows;
  g->lowest = g->moving = 0;
  for (int32_t r = 0; r < rows->count; ++r) {
    dbk_real at_brake = (dbk_real)0, best = (dbk_real)0, worst = (dbk_real)0;
    for (int32_t k = 0; k < model->n; ++k) {
      const dbk_real a = rows->a[k][r];
      at_brake += a * brake[k];
      best += a > (dbk_real)0 ? a * ctx->upper[k] : a * ctx->lower[k];
      worst += a > (dbk_real)0 ? a * ctx->lower[k] : a * ctx->upper[k];
    }
    const dbk_real change = (dbk_real)0.5 * (best - worst);
    g->want[r] = dbk_min(rows->b[r], best);
    const int32_t pair = rows->rank[r] <= DBK_RANK_OBSTACLE;
    g->passive[r] = rows->moving[r] ? passive_part(model, scene, rows, r, change, g->want[r]) : g->want[r];
    g->floor[r] = pair ? dbk_min(g->passive[r], at_brake - DBK_GRANTED) : (dbk_real)-1e9;
    g->level[r] = pair && at_brake >= g->want[r] ? 0 : rows->rank[r];
    g->lowest = g->level[r] > g->lowest ? g->level[r] : g->lowest;
    if (rows->moving[r]) { g->moving |= 1 << g->level[r]; }
  }
}

/* row r once more at the end, asking for all it wants but for a slack */
static void ask_again(dbk_rows *rows, int32_t n, int32_t r, dbk_real want) {
  const int32_t at = rows->count++;
  for (int32_t k = 0; k < n; ++k) { rows->a[k][at] = rows->a[k][r]; }
  rows->b[at] = want;
  rows->soft[at] = dbk_min((dbk_real)1, SOFT / rows->norm[r]);
}

/* rows that fill the last vector must never bind */
static void fill_up(dbk_rows *rows, int32_t n) {
  for (int32_t r = rows->count; r < DBK_MAX_ROWS && r % DBK_LANES != 0; ++r) {
    for (int32_t k = 0; k < n; ++k) { rows->a[k][r] = (dbk_real)0; }
    rows->b[r] = (dbk_real)-1e9;
    rows->soft[r] = (dbk_real)0;
  }
}

/* the least largest violation (in m/s, one slack) of what the rows of a rank want, which from here on they keep; u is the
 * control nearest to braking that has it. Negative where the optimisation failed */
static dbk_real settle(const dbk_model *model, dbk_ctx *ctx, const grades *g, const dbk_real *want, int32_t rank,
                       const dbk_real *brake, dbk_real *u) {
  dbk_rows *rows = &ctx->rows;
  const int32_t n = model->n, count = rows->count;
  for (int32_t r = 0; r < count && rows->count < DBK_MAX_ROWS; ++r) {
    if (g->level[r] == rank) { ask_again(rows, n, r, want[r]); }
  }
  if (rows->count == count) { return (dbk_real)0; }
  fill_up(rows, n);
  const int32_t result = dbk_qp(rows, n, model->scale, ctx->lower, ctx->upper, brake, 1, (dbk_real)0, 0, 0, &ctx->solution);
  rows->count = count;
  fill_up(rows, n);
  if (result != 0) { return (dbk_real)-1; }
  const dbk_real slack = dbk_max(ctx->solution.slack, (dbk_real)0);
  for (int32_t r = 0; r < count; ++r) {
    if (g->level[r] == rank) {
      const dbk_real granted = dbk_min((dbk_real)1, SOFT / rows->norm[r]) * slack + DBK_GRANTED;
      rows->b[r] = dbk_max(rows->b[r], want[r] - granted);
    }
  }
  for (int32_t k = 0; k < n; ++k) { u[k] = dbk_clamp(ctx->solution.u[k], ctx->lower[k], ctx->upper[k]); }
  return slack * SOFT;
}

/* No control meets all rows. The reference is the hardest admissible braking, and no pair (a thing, a person, two parts of
 * the robot) is approached faster than by braking, whatever moves at the robot. Within that, rank by rank, the largest
 * violation is made as small as what came before allows: first as if everything stood still, so that the robot itself does
 * not go toward anything (passive safety); then with what moves, so that it gives way. Answers with one bit for each rank
 * that was given up in part; the rows keep what they were granted. */
int32_t dbk_relax(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, const dbk_real brake[DBK_MAX_DOF],
                  dbk_real u[DBK_MAX_DOF]) {
  dbk_rows *rows = &ctx->rows;
  grades g;
  int32_t given_up = 0;
  grade(model, scene, ctx, brake, &g);
  for (int32_t k = 0; k < model->n; ++k) { u[k] = brake[k]; }
  for (int32_t r = 0; r < rows->count; ++r) {
    rows->b[r] = g.floor[r];
    rows->soft[r] = (dbk_real)0;
  }
  for (int32_t rank = DBK_RANK_BODY; rank <= g.lowest; ++rank) {
    if (g.moving >> rank & 1 && settle(model, ctx, &g, g.passive, rank, brake, u) < (dbk_real)0) { break; }
    const dbk_real violation = settle(model, ctx, &g, g.want, rank, brake, u);
    if (violation < (dbk_real)0) { break; }
    if (violation > DBK_GIVEN_UP) { given_up |= 1 << rank; }
  }
  return given_up;
}
