/* Rows between the links and the obstacles. */
#ifndef DBK_OBSTACLE_ROWS_H
#define DBK_OBSTACLE_ROWS_H

#include "distance/dbk_broadphase.h"

/* appends the rows of all links and obstacles to ctx->rows, and updates ctx->h_min and ctx->revisits */
void dbk_obstacle_rows(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx,
                       const dbk_predicted_obstacles *predicted);

#endif
