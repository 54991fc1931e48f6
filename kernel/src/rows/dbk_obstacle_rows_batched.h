/* Rows between one link and many plain capsules. */
#ifndef DBK_OBSTACLE_ROWS_BATCHED_H
#define DBK_OBSTACLE_ROWS_BATCHED_H

#include "distance/dbk_broadphase.h"

/* appends the rows of a link and all its candidates that dbk_uses_plain_capsule selects */
void dbk_obstacle_rows_batched(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx,
                               const dbk_predicted_obstacles *predicted, const dbk_link_candidates *link);

#endif
