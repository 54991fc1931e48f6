/* Rows of the barrier functions (paper 4.2): for a sphere at distance h along the outward normal n of an obstacle,
 *
 *   n'J u  >=  -s(h) + n'v_o + velocity_error + sum_k tracking_k |n'J_k| + max(0, -dt/2 n'a)
 *
 * with a the acceleration of the sphere's centre at constant u (for two links the second derivative of the distance in
 * place of n'a), and s = min(alpha h, max(0, 2 g h - C/(4 g))) with g = min a/v and C = max(0, -n'a)
 * (dbk_approach_speed). The last term is the sampling term, and -s is at most the recovery speed. A row is omitted only
 * if no control within the bounds can violate it and h is above the cull floor. If contact is permitted, the contact-speed row
 * n'(J u - v_o) >= -max(speed, s) replaces the barrier. If speed and separation monitoring is on, n'J u >= -v_max(h)
 * holds in addition, as far as braking can follow it. The rows of the speed limits are in speed/.
 */
#include "dbk_build_rows.h"

#include "distance/dbk_broadphase.h"
#include "rows/dbk_obstacle_rows.h"
#include "rows/dbk_row_jacobian.h"
#include "rows/dbk_self_collision_rows.h"
#include "speed/dbk_speed_limit.h"

static void mark_unavoidable(dbk_rows *rows, int32_t kind, int32_t i, int32_t j, dbk_real h) {
  rows->unavoidable = 1;
  rows->fixed_kind = kind;
  rows->fixed_i = i;
  rows->fixed_j = j;
  rows->fixed_h = h;
}

/* A row that no joint can change is acceptable if it requires no motion, or if a static obstacle touches the mount of
 * the robot. Otherwise it is unavoidable, and if h < 0 the step stops. */
static void classify_fixed_row(const dbk_model *model, dbk_rows *rows, int32_t r) {
  const int32_t sphere = dbk_bounded(rows->i[r], DBK_ALL_SPHERES - 1);
  const int32_t mount = rows->kind[r] == DBK_ROW_OBSTACLE && model->sphere_frame[sphere] <= 1 && !rows->moving[r];
  if (rows->b[r] <= (dbk_real)0 || mount) { return; }
  if (rows->h[r] + model->sampling < (dbk_real)0) { rows->no_gradient = 1; }
  mark_unavoidable(rows, rows->kind[r], rows->i[r], rows->j[r], rows->h[r] + model->sampling);
}

static void move_row(const dbk_model *model, dbk_rows *rows, int32_t to, int32_t r) {
  for (int32_t k = 0; k < model->n; ++k) { rows->a[k][to] = rows->a[k][r]; }
  rows->b[to] = rows->b[r];
  rows->h[to] = rows->h[r];
  rows->norm[to] = rows->norm[r];
  rows->kind[to] = rows->kind[r];
  rows->i[to] = rows->i[r];
  rows->j[to] = rows->j[r];
  rows->moving[to] = rows->moving[r];
  rows->rank[to] = rows->rank[r];
  rows->clip[to] = rows->clip[r];
  rows->nx[to] = rows->nx[r];
  rows->ny[to] = rows->ny[r];
  rows->nz[to] = rows->nz[r];
}

/* classifies and removes the rows with a zero gradient */
static void remove_fixed_rows(const dbk_model *model, dbk_rows *rows) {
  int32_t kept = 0;
  for (int32_t r = 0; r < rows->count && kept < DBK_MAX_ROWS; ++r) {
    if (!(rows->norm[r] > DBK_ZERO_GRADIENT)) {
      classify_fixed_row(model, rows, r);
      continue;
    }
    if (kept != r) { move_row(model, rows, kept, r); }
    ++kept;
  }
  rows->count = kept;
}

/* limits the right side of recovery rows (h < 0) and contact rows to the maximum of a'u over the control bounds */
static void clip_to_bounds(const dbk_model *model, const dbk_ctx *ctx, dbk_rows *rows) {
  for (int32_t r = 0; r < rows->count; ++r) {
    if (!rows->clip[r] && rows->h[r] >= (dbk_real)0) { continue; }
    dbk_real best = (dbk_real)0;
    for (int32_t k = 0; k < model->n; ++k) {
      const dbk_real a = rows->a[k][r], low = a * ctx->lower[k], high = a * ctx->upper[k];
      best += low > high ? low : high;
    }
    rows->b[r] = dbk_min(rows->b[r], best - DBK_QP_SHIFT * 4 * rows->norm[r]);
  }
}

/* normalises the rows, so that row tolerances are in rad/s, and removes the sampling margin from h */
static inline void normalise(const dbk_model *model, dbk_rows *rows) {
  dbk_real inverse[DBK_ROW_CAPACITY];
  const int32_t count = DBK_PADDED(rows->count);
  for (int32_t r = 0; r < count; ++r) {
    inverse[r] = (dbk_real)1 / rows->norm[r];
    rows->b[r] *= inverse[r];
    rows->h[r] += model->sampling;
  }
  for (int32_t k = 0; k < model->n; ++k) {
    dbk_real *restrict a = rows->a[k];
    for (int32_t r = 0; r < count; ++r) { a[r] *= inverse[r]; }
  }
}

/* appends the user rows, normalised */
static void append_user_rows(const dbk_model *model, const dbk_scene *scene, dbk_rows *rows) {
  for (int32_t u = 0; u < scene->n_user; ++u) {
    dbk_real square = (dbk_real)0;
    for (int32_t k = 0; k < model->n; ++k) { square += scene->user_a[u][k] * scene->user_a[u][k]; }
    const dbk_real norm = dbk_sqrt(square);
    if (!(norm > DBK_ZERO_GRADIENT)) {
      if (!(scene->user_b[u] <= (dbk_real)0)) {
        mark_unavoidable(rows, DBK_ROW_USER, u, 0, scene->user_h[u]);
      }
      continue;
    }
    if (rows->count >= DBK_MAX_ROWS) {
      rows->overflow = 1;
      return;
    }
    const int32_t r = rows->count++;
    for (int32_t k = 0; k < model->n; ++k) { rows->a[k][r] = scene->user_a[u][k] / norm; }
    rows->b[r] = scene->user_b[u] / norm;
    rows->h[r] = scene->user_h[u];
    rows->norm[r] = norm;
    rows->kind[r] = DBK_ROW_USER;
    rows->i[r] = u;
    rows->j[r] = 0;
    rows->moving[r] = rows->clip[r] = 0;
    rows->rank[r] = scene->user_rank[u];
  }
}

/* fills the last SIMD vector with rows that never bind */
static void pad_rows(const dbk_model *model, dbk_rows *rows) {
  for (int32_t r = rows->count; r < DBK_PADDED(rows->count); ++r) {
    for (int32_t k = 0; k < model->n; ++k) { rows->a[k][r] = (dbk_real)0; }
    rows->b[r] = (dbk_real)-1e9;
    rows->soft[r] = (dbk_real)0;
  }
}

/* Converts normals to normalised rows. This must not be the last call of dbk_finish_rows: gcc 12 would then omit
 * vzeroupper, which costs the following code some hundred nanoseconds. */
DBK_SIMD_CLONES static void to_joint_space(const dbk_model *model, dbk_ctx *ctx) {
  dbk_rows *rows = &ctx->rows;
  dbk_real square[DBK_ROW_CAPACITY], total[DBK_ROW_CAPACITY];
  int32_t fixed = 0, clip = 0;
  dbk_row_jacobian(model, ctx, rows, square, total);
  /* the norm of every row, and the tracking term sum_k tracking_k |a_k| */
  for (int32_t r = 0; r < rows->count; ++r) {
    const dbk_real norm = dbk_sqrt(square[r]);
    rows->norm[r] = norm;
    rows->b[r] += model->tracking_max * total[r];
    fixed |= !(norm > DBK_ZERO_GRADIENT);
    clip |= rows->clip[r] | !(rows->h[r] >= (dbk_real)0);
  }
  if (fixed) { remove_fixed_rows(model, rows); }
  if (clip) { clip_to_bounds(model, ctx, rows); }
  normalise(model, rows);
}

void dbk_finish_rows(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx) {
  to_joint_space(model, ctx);
  append_user_rows(model, scene, &ctx->rows);
  if (ctx->speed.active) { dbk_speed_rows(model, ctx); }
  pad_rows(model, &ctx->rows);
}

void dbk_build_rows(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, dbk_real age, dbk_real extra,
                    int32_t known_only) {
  ctx->rows.count = ctx->rows.overflow = ctx->rows.no_gradient = ctx->rows.unavoidable = ctx->rows.n_spans = 0;
  ctx->revisits.count = 0;
  ctx->narrow_phase_count = 0;
  ctx->h_min = DBK_MAX_DISTANCE;
  dbk_start_from_nearest_links(model, scene, ctx, extra);
  if (scene->n_obstacles > 0) {
    dbk_predicted_obstacles predicted;
    dbk_predict_obstacles(model, scene, age, extra, known_only, &predicted);
    dbk_obstacle_rows(model, scene, ctx, &predicted);
  }
  dbk_self_collision_rows(model, scene, ctx, extra);
  dbk_finish_rows(model, scene, ctx);
}
