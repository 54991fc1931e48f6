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

/* the rows from `first` on are moved by the joints from..upto-1 */
static void open_span(dbk_rows *rows, int32_t first, int32_t from, int32_t upto) {
  const int32_t at = rows->n_spans;
  if (at > 0 && rows->span_from[at - 1] == from && rows->span_upto[at - 1] == upto) { return; }
  rows->span_first[at] = first;
  rows->span_from[at] = from;
  rows->span_upto[at] = upto;
  rows->n_spans = at + 1;
}

/* places of the pairs that are to be kept, in order; when there is no more room, that is told, and the step brakes */
static inline int32_t list_kept(const dbk_batch *w, dbk_rows *rows, int32_t *restrict kept) {
  int32_t n = 0;
  for (int32_t at = 0; at < w->count; ++at) {
    kept[n] = at;
    n += w->keep[at];
  }
  if (n > DBK_MAX_ROWS - rows->count) {
    rows->overflow = 1;
    n = DBK_MAX_ROWS - rows->count;
  }
  return n;
}

/* c x n, with c the centre of each row's sphere */
static inline void fill_moments(const dbk_cloud *cloud, const dbk_batch *w, dbk_rows *restrict rows, int32_t first) {
  const dbk_real *nx = rows->nx, *ny = rows->ny, *nz = rows->nz;
  const int32_t same = w->sphere >= 0 ? w->sphere : 0;
  dbk_real x = cloud->x[same], y = cloud->y[same], z = cloud->z[same];
  if (w->sphere >= 0) {
    for (int32_t r = first; r < rows->count; ++r) {
      rows->mx[r] = y * nz[r] - z * ny[r];
      rows->my[r] = z * nx[r] - x * nz[r];
      rows->mz[r] = x * ny[r] - y * nx[r];
    }
    return;
  }
  for (int32_t r = first; r < rows->count; ++r) {
    x = cloud->x[rows->i[r]];
    y = cloud->y[rows->i[r]];
    z = cloud->z[rows->i[r]];
    rows->mx[r] = y * nz[r] - z * ny[r];
    rows->my[r] = z * nx[r] - x * nz[r];
    rows->mz[r] = x * ny[r] - y * nx[r];
  }
}

/* takes the pairs of a batch that are to be kept as rows */
DBK_WIDE void dbk_keep_rows(const dbk_scene *scene, dbk_ctx *ctx, const dbk_batch *w) {
  dbk_rows *restrict rows = &ctx->rows;
  const dbk_covers *c = &scene->covers;
  const int32_t first = rows->count;
  int32_t kept[DBK_BATCH];
  const int32_t last = first + list_kept(w, rows, kept);
  if (first == last) { return; }
  open_span(rows, first, w->from, w->upto);
  rows->count = last;
  int32_t *restrict vary = w->sphere >= 0 ? rows->j : rows->i, *restrict same = w->sphere >= 0 ? rows->i : rows->j;
  const int32_t fixed = w->sphere >= 0 ? w->sphere : w->other;
  for (int32_t r = first; r < last; ++r) {
    const int32_t at = kept[r - first];
    rows->h[r] = w->h[at];
    rows->b[r] = w->rhs[at];
    rows->nx[r] = w->nx[at];
    rows->ny[r] = w->ny[at];
    rows->nz[r] = w->nz[at];
    rows->yielding[r] = w->yielding[at];
    vary[r] = w->index[at];
  }
  for (int32_t r = first; r < last; ++r) {
    same[r] = fixed;
    rows->kind[r] = w->kind;
    rows->moving[r] = 0;
    rows->rank[r] = DBK_RANK_BODY;
  }
  if (w->kind == DBK_ROW_OBSTACLE) {
    for (int32_t r = first; r < last; ++r) {
      rows->moving[r] = c->moving[rows->j[r]];
      rows->rank[r] = c->rank[rows->j[r]];
    }
  }
  fill_moments(&ctx->cloud, w, rows, first);
}

/* n'J_k = z_k'(c x n) - n'(z_k x p_k), or n'z_k where joint k slides, for the rows first..last-1 */
static inline void fill_column(const dbk_model *model, const dbk_frames *frames, dbk_rows *rows, int32_t k, int32_t first,
                               int32_t last, dbk_real *restrict square, dbk_real *restrict total) {
  const dbk_real *f = frames->rotation[k + 1];
  const dbk_real *p = frames->origin[k + 1];
  const dbk_real zx = f[2], zy = f[5], zz = f[8];
  const int32_t slides = model->joint_kind[k] == DBK_PRISMATIC;
  const dbk_real tx = slides ? (dbk_real)0 : zx, ty = slides ? (dbk_real)0 : zy, tz = slides ? (dbk_real)0 : zz;
  const dbk_real mx = slides ? -zx : zy * p[2] - zz * p[1], my = slides ? -zy : zz * p[0] - zx * p[2];
  const dbk_real mz = slides ? -zz : zx * p[1] - zy * p[0];
  const dbk_real *restrict rx = rows->mx, *restrict ry = rows->my, *restrict rz = rows->mz;
  const dbk_real *restrict nx = rows->nx, *restrict ny = rows->ny, *restrict nz = rows->nz;
  dbk_real *restrict a = rows->a[k];
  for (int32_t r = first; r < last; ++r) {
    const dbk_real mine = (tx * rx[r] + ty * ry[r] + tz * rz[r]) - (mx * nx[r] + my * ny[r] + mz * nz[r]);
    a[r] = mine;
    square[r] += mine * mine;
    total[r] += mine < (dbk_real)0 ? -mine : mine;
  }
}

/* the columns of every span; joints that do not move it get zero */
static inline void fill_columns(const dbk_model *model, const dbk_ctx *ctx, dbk_rows *rows, dbk_real *restrict square,
                                dbk_real *restrict total) {
  for (int32_t r = 0; r < rows->count; ++r) { square[r] = total[r] = (dbk_real)0; }
  for (int32_t s = 0; s < rows->n_spans; ++s) {
    const int32_t first = rows->span_first[s], last = s + 1 < rows->n_spans ? rows->span_first[s + 1] : rows->count;
    for (int32_t k = 0; k < model->n; ++k) {
      if (k >= rows->span_from[s] && k < rows->span_upto[s]) {
        fill_column(model, &ctx->frames, rows, k, first, last, square, total);
      } else {
        for (int32_t r = first; r < last; ++r) { rows->a[k][r] = (dbk_real)0; }
      }
    }
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
  dbk_real inverse[DBK_MAX_ROWS];
  for (int32_t r = 0; r < rows->count; ++r) {
    inverse[r] = (dbk_real)1 / rows->norm[r];
    rows->b[r] *= inverse[r];
    rows->h[r] += model->sampling;
  }
  for (int32_t k = 0; k < model->n; ++k) {
    dbk_real *restrict a = rows->a[k];
    for (int32_t r = 0; r < rows->count; ++r) { a[r] *= inverse[r]; }
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

/* from normals to unit rows of the QP */
DBK_WIDE void dbk_finish_rows(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx) {
  dbk_rows *rows = &ctx->rows;
  dbk_real square[DBK_MAX_ROWS], total[DBK_MAX_ROWS];
  int32_t fixed = 0, yielding = 0;
  fill_columns(model, ctx, rows, square, total);
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
  user_rows(model, scene, rows);
  pad(model, rows);
}

void dbk_build_rows(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, dbk_real age, dbk_real extra,
                    int32_t known_only) {
  ctx->rows.count = ctx->rows.overflow = ctx->rows.stuck = ctx->rows.unavoidable = ctx->rows.n_spans = 0;
  ctx->visits.count = 0;
  ctx->h_min = DBK_BEYOND;
  if (scene->n_obstacles > 0) {
    dbk_surround around;
    dbk_surroundings(model, scene, age, extra, known_only, &around);
    dbk_meet_obstacles(model, scene, ctx, &around);
  }
  dbk_meet_self(model, scene, ctx, extra);
  dbk_finish_rows(model, scene, ctx);
}
