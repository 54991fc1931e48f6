/* Row buffer: appends the rows of batches, records h_min and the pairs for the certificate. */
#ifndef DBK_ROW_BUFFER_H
#define DBK_ROW_BUFFER_H

#include "distance/dbk_broadphase.h"
#include "rows/dbk_pairs.h"

/* appends the pairs of a batch with keep[] = 1 to ctx->rows */
void dbk_append_rows(const dbk_scene *scene, dbk_ctx *ctx, const dbk_pair_batch *batch);

/* adds the pairs of the spheres first..first+count-1 and the body `other` to the list for the certificate */
void dbk_revisit_pairs(dbk_ctx *ctx, int32_t first, int32_t count, int32_t other);

/* updates h_min by the smallest h between a link and an obstacle, and adds the pair to the list for the certificate if
 * it could reach h = 0 within one period */
static inline void dbk_record_distance(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx,
                                       const dbk_link_candidates *link, int32_t obstacle, dbk_real least) {
  const dbk_real speed = scene->capsules.max_speed[obstacle] + ctx->motion.max_speed[link->link];
  ctx->h_min = dbk_min(ctx->h_min, least + model->sampling);
  if (!(least >= model->period * speed + DBK_CULL_FLOOR)) {
    dbk_revisit_pairs(ctx, link->first, link->count, obstacle);
  }
}

#endif
