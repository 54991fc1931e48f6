/* Retreat: approaching obstacles that the robot evades within the acceleration limits of the joints. */
#ifndef DBK_RETREAT_H
#define DBK_RETREAT_H

#include "dbk_math.h"

/* 1: every row that u violates belongs to an approaching obstacle, and u begins a retreat that ends the approach before
 * h = 0. `b` is the right side of each of the first `count` rows before the relaxation */
int32_t dbk_retreats_in_time(const dbk_model *model, const dbk_scene *scene, const dbk_ctx *ctx, const dbk_real *b,
                             int32_t count, const dbk_real u_prev[DBK_MAX_DOF], const dbk_real u[DBK_MAX_DOF]);

#endif
