/* Relaxation: the least violation of the rows if no control satisfies all of them. */
#ifndef DBK_RELAXATION_H
#define DBK_RELAXATION_H

#include "dbk_math.h"

/* computes u with the least violation, rank by rank; `brake` is the braking control. Returns bit r if rows of rank r
 * are violated. The right sides of ctx->rows are changed to the granted values */
int32_t dbk_relax(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, const dbk_real brake[DBK_MAX_DOF],
                  dbk_real u[DBK_MAX_DOF]);

#endif
