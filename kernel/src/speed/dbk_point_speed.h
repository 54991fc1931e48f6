/* Velocities of the points whose speed is limited: the centre of every collision sphere, and the tool. */
#ifndef DBK_POINT_SPEED_H
#define DBK_POINT_SPEED_H

#include "dbk_math.h"

/* velocities and accelerations of all points at a constant control; point `ctx->spheres.count` is the tool */
typedef struct {
  dbk_real vx[DBK_SPHERE_CAPACITY], vy[DBK_SPHERE_CAPACITY], vz[DBK_SPHERE_CAPACITY];
  dbk_real ax[DBK_SPHERE_CAPACITY], ay[DBK_SPHERE_CAPACITY], az[DBK_SPHERE_CAPACITY];
} dbk_point_velocities;

/* sets ctx->speed.tool, the position of the tool */
void dbk_place_tool(const dbk_model *model, dbk_ctx *ctx);

/* velocities only */
void dbk_velocities_of_points(const dbk_model *model, const dbk_scene *scene, const dbk_ctx *ctx,
                              const dbk_real u[DBK_MAX_DOF], dbk_point_velocities *out);

/* velocities and accelerations */
void dbk_motion_of_points(const dbk_model *model, const dbk_scene *scene, const dbk_ctx *ctx,
                          const dbk_real u[DBK_MAX_DOF], dbk_point_velocities *out);

/* number of the frame that moves a point, and its position */
int32_t dbk_frame_of_point(const dbk_model *model, const dbk_ctx *ctx, int32_t point, dbk_real position[3]);

#endif
