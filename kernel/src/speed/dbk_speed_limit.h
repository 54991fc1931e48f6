/* Speed limits: |J_p u| <= v for every point p of the robot, a cone, as far as the control bounds permit.
 *
 * A solution that is too fast is cut off by the row n'J_p u <= v with n the direction of the velocity of p, and the QP
 * is solved again. Every cut holds for all admissible controls, so a solution that keeps the limits is the closest one,
 * up to DBK_SPEED_SHRINK. Only an evaluation of all speeds accepts a control. The limits are convex, and the braking
 * control of the step keeps them: a control between an admissible one and this one keeps them as well.
 */
#ifndef DBK_SPEED_LIMIT_H
#define DBK_SPEED_LIMIT_H

#include "speed/dbk_point_speed.h"

/* Sets the limits of all points for a step from the control u_prev; the kinematics must be set. With `u_change`, the
 * last change of the control, the speeds also stay within their limits while the acceleration is reduced to zero within
 * the jerk limits. With `known_only` the
 * obstacles without the flag DBK_KNOWN have no limits, and the limits are slightly smaller, as for a projection. */
void dbk_set_speed_limits(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, const dbk_in *in,
                          const dbk_real u_prev[DBK_MAX_DOF], const dbk_real *u_change, int32_t known_only);

/* 1: no point is faster than its limit */
int32_t dbk_keeps_speed(const dbk_model *model, const dbk_scene *scene, const dbk_ctx *ctx,
                        const dbk_real u[DBK_MAX_DOF]);

/* Adds cuts and their rows for the points that are too fast at u. Returns 0 if no point is too fast, 1 if the rows are
 * new, -1 if there is no room for them. */
int32_t dbk_cut_speed(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, const dbk_real u[DBK_MAX_DOF]);

/* moves u toward braking, by as little as a bisection resolves, until no point is too fast */
void dbk_slow_down(const dbk_model *model, const dbk_scene *scene, const dbk_ctx *ctx,
                   const dbk_real brake[DBK_MAX_DOF], dbk_real u[DBK_MAX_DOF]);

/* velocities of all points at u, or after the ramp that follows u; returns the limits for them */
const dbk_real *dbk_limited_velocities(const dbk_model *model, const dbk_scene *scene, const dbk_ctx *ctx,
                                       const dbk_real u[DBK_MAX_DOF], int32_t ramped, dbk_point_velocities *out);

/* appends the rows of all cuts */
void dbk_speed_rows(const dbk_model *model, dbk_ctx *ctx);

/* the rows of all cuts, and no others */
void dbk_only_speed_rows(const dbk_model *model, dbk_ctx *ctx);

#endif
