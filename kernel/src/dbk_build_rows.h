/* Constraint rows of one step. */
#ifndef DBK_BUILD_ROWS_H
#define DBK_BUILD_ROWS_H

#include "dbk_math.h"

/* builds ctx->rows from ctx->frames, ctx->spheres and ctx->motion, and sets ctx->h_min and ctx->revisits; `age` is the
 * age of the scene [s], `extra` an extra clearance [m]; unknown obstacles are ignored if `known_only` */
void dbk_build_rows(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, dbk_real age, dbk_real extra,
                    int32_t known_only);

/* converts the normals in ctx->rows to normalised rows in joint space, and appends the user rows */
void dbk_finish_rows(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx);

#endif
