/* Rows of the barrier functions (paper 4.2): for a sphere at distance h along the outward normal n of an obstacle,
 *
 *   n'J u  >=  -alpha(h) + n'v_o + velocity_error + tracking * sum_k |n'J_k| + max(0, -dt/2 n'a)
 *
 * with a the centre's acceleration at constant u (the sampling term), alpha(h) = alpha h, and for h < 0 the recovery
 * min(alpha |h|, recovery). A row is left out only when no control of the box can violate it and h is above a floor.
 * Where contact is permitted, the contact-speed row n'(J u - v_o) >= -max(speed, alpha h) takes its place. Where speed and
 * separation are asked for, n'J u >= -v_max(h) holds as well, as far as braking can follow it.
 */
#include "dbk_pair.h"

/* what could reach h = 0 within one period is looked at again by the certificate */
void dbk_remember(dbk_ctx *ctx, int32_t first, int32_t count, int32_t other) {
  const int32_t at = ctx->visits.count;
  if (at >= DBK_MAX_VISITS) {
    ctx->rows.overflow = 1;
    return;
  }
  ctx->visits.first[at] = (int16_t)first;
  ctx->visits.spheres[at] = (int16_t)count;
  ctx->visits.other[at] = (int16_t)other;
  ctx->visits.count = at + 1;
}

/* the rows from `first` on are moved by the joints from..upto-1, and belong to one sphere each time or to several */
static void open_span(dbk_rows *rows, int32_t first, const dbk_batch *w) {
  const int32_t at = rows->n_spans, several = w->sphere == DBK_SEVERAL;
  if (at > 0 && rows->span_from[at - 1] == w->from && rows->span_upto[at - 1] == w->upto &&
      rows->span_several[at - 1] == several) {
    return;
  }
  rows->span_first[at] = first;
  rows->span_from[at] = w->from;
  rows->span_upto[at] = w->upto;
  rows->span_several[at] = several;
  rows->n_spans = at + 1;
}

/* copies the pairs that are to be kept behind the rows there are. When there is no more room, that is told, and the step
 * brakes. */
static inline void copy_kept(const dbk_batch *w, dbk_rows *restrict rows) {
  int32_t *restrict vary = w->sphere >= 0 ? rows->j : rows->i;
  int32_t kept[DBK_BATCH + 1], count = 0;
  const int32_t first = rows->count, room = DBK_MAX_ROWS - first;
  for (int32_t at = 0; at < w->count; ++at) {
    kept[count] = at;
    count += w->keep[at];
  }
  if (count > room) {
    rows->overflow = 1;
    count = room;
  }
  for (int32_t i = 0; i < count; ++i) {
    const int32_t at = kept[i], r = first + i;
    rows->h[r] = w->h[at];
    rows->b[r] = w->rhs[at];
    rows->nx[r] = w->nx[at];
    rows->ny[r] = w->ny[at];
    rows->nz[r] = w->nz[at];
    rows->yielding[r] = w->yielding[at];
    vary[r] = w->index[at];
  }
  rows->count = first + count;
}

/* takes the pairs of a batch that are to be kept as rows */
DBK_WIDE void dbk_keep_rows(const dbk_scene *scene, dbk_ctx *ctx, const dbk_batch *w) {
  dbk_rows *restrict rows = &ctx->rows;
  const dbk_covers *c = &scene->covers;
  const int32_t first = rows->count;
  copy_kept(w, rows);
  if (first == rows->count) { return; }
  open_span(rows, first, w);
  int32_t *restrict same = w->sphere >= 0 ? rows->i : rows->j;
  const int32_t fixed = w->sphere >= 0 ? w->sphere : w->other, obstacle = w->kind == DBK_ROW_OBSTACLE;
  const int32_t count = rows->count;
  for (int32_t r = first; r < count; ++r) {
    same[r] = fixed;
    rows->kind[r] = w->kind;
  }
  for (int32_t r = first; r < count; ++r) {
    rows->moving[r] = obstacle ? c->moving[rows->j[r]] : 0;
    rows->rank[r] = obstacle ? c->rank[rows->j[r]] : DBK_RANK_BODY;
  }
}

/* a row that no joint can change: fine if nothing is needed, or if it is the mount that stands there */
static void judge_fixed(const dbk_model *model, dbk_rows *rows, int32_t r) {
  const int32_t mount = rows->kind[r] == DBK_ROW_OBSTACLE && model->sphere_frame[rows->i[r]] <= 1 && !rows->moving[r];
  if (rows->b[r] <= (dbk_real)0 || mount) { return; }
  if (rows->h[r] + model->sampling < (dbk_real)0) { rows->stuck = 1; }
  rows->unavoidable = 1;
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
  rows->yielding[to] = rows->yielding[r];
  rows->nx[to] = rows->nx[r];
  rows->ny[to] = rows->ny[r];
  rows->nz[to] = rows->nz[r];
}

/* rows without a gradient are judged and leave */
static void drop_fixed(const dbk_model *model, dbk_rows *rows) {
  int32_t kept = 0;
  for (int32_t r = 0; r < rows->count; ++r) {
    if (!(rows->norm[r] > DBK_ZERO_GRADIENT)) {
      judge_fixed(model, rows, r);
      continue;
    }
    if (kept != r) { move_row(model, rows, kept, r); }
    ++kept;
  }
  rows->count = kept;
}

/* recovery and contact rows ask for no more than the box can give */
static void yield(const dbk_model *model, const dbk_ctx *ctx, dbk_rows *rows) {
  for (int32_t r = 0; r < rows->count; ++r) {
    if (!rows->yielding[r] && rows->h[r] >= (dbk_real)0) { continue; }
    dbk_real best = (dbk_real)0;
    for (int32_t k = 0; k < model->n; ++k) {
      const dbk_real a = rows->a[k][r], low = a * ctx->lower[k], high = a * ctx->upper[k];
      best += low > high ? low : high;
    }
    rows->b[r] = dbk_min(rows->b[r], best - DBK_QP_SHIFT * 4 * rows->norm[r]);
  }
}

/* unit rows, so that row tolerances are in rad/s; from here on h is what remains to h = 0 without the sampling margin */
static inline void make_unit(const dbk_model *model, dbk_rows *rows) {
  dbk_real inverse[DBK_ROW_ROOM];
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

/* rows that were handed in, as unit rows after all others */
static void user_rows(const dbk_model *model, const dbk_scene *scene, dbk_rows *rows) {
  for (int32_t u = 0; u < scene->n_user; ++u) {
    dbk_real square = (dbk_real)0;
    for (int32_t k = 0; k < model->n; ++k) { square += scene->user_a[u][k] * scene->user_a[u][k]; }
    const dbk_real norm = dbk_sqrt(square);
    if (!(norm > DBK_ZERO_GRADIENT)) {
      if (!(scene->user_b[u] <= (dbk_real)0)) { rows->unavoidable = 1; }
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
    rows->moving[r] = rows->yielding[r] = 0;
    rows->rank[r] = scene->user_rank[u];
  }
}

/* empty rows fill the last vector */
static void pad(const dbk_model *model, dbk_rows *rows) {
  for (int32_t r = rows->count; r < DBK_PADDED(rows->count); ++r) {
    for (int32_t k = 0; k < model->n; ++k) { rows->a[k][r] = (dbk_real)0; }
    rows->b[r] = (dbk_real)-1e9;
    rows->soft[r] = (dbk_real)0;
  }
}

/* from normals to unit rows; not the last of dbk_finish_rows, as gcc 12 forgets there to clear the upper halves of the
 * vectors, which costs whatever comes next some hundred nanoseconds */
DBK_WIDE static void turn_to_joints(const dbk_model *model, dbk_ctx *ctx) {
  dbk_rows *rows = &ctx->rows;
  dbk_real square[DBK_ROW_ROOM], total[DBK_ROW_ROOM];
  int32_t fixed = 0, yielding = 0;
  dbk_fill_columns(model, ctx, rows, square, total);
  for (int32_t r = 0; r < rows->count; ++r) {
    const dbk_real norm = dbk_sqrt(square[r]);
    rows->norm[r] = norm;
    rows->b[r] += model->tracking * total[r];
    fixed |= !(norm > DBK_ZERO_GRADIENT);
    yielding |= rows->yielding[r] | !(rows->h[r] >= (dbk_real)0);
  }
  if (fixed) { drop_fixed(model, rows); }
  if (yielding) { yield(model, ctx, rows); }
  make_unit(model, rows);
}

/* from normals to unit rows of the QP */
void dbk_finish_rows(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx) {
  turn_to_joints(model, ctx);
  user_rows(model, scene, &ctx->rows);
  pad(model, &ctx->rows);
}

void dbk_build_rows(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, dbk_real age, dbk_real extra,
                    int32_t known_only) {
  ctx->rows.count = ctx->rows.overflow = ctx->rows.stuck = ctx->rows.unavoidable = ctx->rows.n_spans = 0;
  ctx->visits.count = ctx->glances = 0;
  ctx->h_min = DBK_BEYOND;
  if (scene->n_obstacles > 0) {
    dbk_surround around;
    dbk_surroundings(model, scene, age, extra, known_only, &around);
    dbk_meet_obstacles(model, scene, ctx, &around);
  }
  dbk_meet_self(model, scene, ctx, extra);
  dbk_finish_rows(model, scene, ctx);
}
