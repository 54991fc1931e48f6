/* Row buffer: appends the rows of batches and the pairs for the certificate. A full buffer sets rows.overflow, and the
 * step then brakes. */
#include "rows/dbk_row_buffer.h"

void dbk_revisit_pairs(dbk_ctx *ctx, int32_t first, int32_t count, int32_t other) {
  const int32_t at = ctx->revisits.count;
  if (at >= DBK_MAX_REVISITS) {
    ctx->rows.overflow = 1;
    return;
  }
  ctx->revisits.first_sphere[at] = (int16_t)first;
  ctx->revisits.n_spheres[at] = (int16_t)count;
  ctx->revisits.other[at] = (int16_t)other;
  ctx->revisits.count = at + 1;
}

/* starts a span at row `first`, unless the last span has the same joints and the same form of (mx, my, mz) */
static void open_span(dbk_rows *rows, int32_t first, const dbk_pair_batch *batch) {
  const int32_t at = dbk_bounded(rows->n_spans, DBK_MAX_SPANS), many_spheres = batch->sphere == DBK_MANY_SPHERES;
  if (at > 0 && rows->span_first_joint[at - 1] == batch->first_joint &&
      rows->span_end_joint[at - 1] == batch->end_joint && rows->span_many_spheres[at - 1] == many_spheres) {
    return;
  }
  rows->overflow |= at >= DBK_MAX_SPANS; /* never: there are fewer pairs of bodies */
  if (at >= DBK_MAX_SPANS) { return; }
  rows->span_first[at] = first;
  rows->span_first_joint[at] = batch->first_joint;
  rows->span_end_joint[at] = batch->end_joint;
  rows->span_many_spheres[at] = many_spheres;
  rows->n_spans = at + 1;
}

/* appends the pairs with keep[] = 1 */
static inline void copy_kept(const dbk_pair_batch *batch, dbk_rows *restrict rows) {
  int32_t *restrict varying = batch->sphere >= 0 ? rows->j : rows->i;
  int32_t r = rows->count;
  for (int32_t at = 0; at < batch->count; ++at) {
    if (!batch->keep[at]) { continue; }
    if (r >= DBK_MAX_ROWS) {
      rows->overflow = 1;
      break;
    }
    rows->h[r] = batch->h[at];
    rows->b[r] = batch->rhs[at];
    rows->nx[r] = batch->nx[at];
    rows->ny[r] = batch->ny[at];
    rows->nz[r] = batch->nz[at];
    rows->clip[r] = batch->clip[at];
    varying[r] = batch->index[at];
    ++r;
  }
  rows->count = r;
}

DBK_SIMD_CLONES void dbk_append_rows(const dbk_scene *scene, dbk_ctx *ctx, const dbk_pair_batch *batch) {
  dbk_rows *restrict rows = &ctx->rows;
  const dbk_obstacle_capsules *c = &scene->capsules;
  const int32_t first = rows->count;
  copy_kept(batch, rows);
  if (first == rows->count) { return; }
  open_span(rows, first, batch);
  /* the side that is common to all pairs, and the kind */
  int32_t *restrict same = batch->sphere >= 0 ? rows->i : rows->j;
  const int32_t common = batch->sphere >= 0 ? batch->sphere : batch->other, obstacle = batch->kind == DBK_ROW_OBSTACLE;
  const int32_t count = rows->count;
  for (int32_t r = first; r < count; ++r) {
    same[r] = common;
    rows->kind[r] = batch->kind;
  }
  /* the rank and the motion of the obstacle; self-collision rows have the highest rank */
  for (int32_t r = first; r < count; ++r) {
    const int32_t o = dbk_bounded(rows->j[r], DBK_OBSTACLE_CAPACITY - 1);
    rows->moving[r] = obstacle ? c->moving[o] : 0;
    rows->rank[r] = obstacle ? c->rank[o] : DBK_RANK_BODY;
  }
}
