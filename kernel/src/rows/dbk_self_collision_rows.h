/* Rows between the links of the robot, and between the links and the held object. */
#ifndef DBK_SELF_COLLISION_ROWS_H
#define DBK_SELF_COLLISION_ROWS_H

#include "dbk_math.h"

/* sets ctx->h_min to the smallest h of ctx->nearest, a link pair and a proximal sphere, if it exists in this step */
void dbk_start_from_nearest_links(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, dbk_real extra);

/* appends the rows of all link pairs to ctx->rows with `extra` clearance [m], and updates ctx->h_min and
 * ctx->revisits */
void dbk_self_collision_rows(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, dbk_real extra);

#endif
