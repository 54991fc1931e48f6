/* Velocities, accelerations and speed bounds of the collision spheres. */
#ifndef DBK_SPHERE_MOTION_H
#define DBK_SPHERE_MOTION_H

#include "dbk_math.h"

/* sets ctx->motion from ctx->frames, ctx->spheres, the control bounds and the trust region */
void dbk_set_sphere_motion(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx);

#endif
