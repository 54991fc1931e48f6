/* Bounds of the control from the velocity, acceleration, jerk and position limits of the joints, and braking within
 * them. */
#ifndef DBK_CONTROL_BOUNDS_H
#define DBK_CONTROL_BOUNDS_H

#include "dbk_math.h"

/* bounds at joint position y after the previous control u_prev; sets *conflict to 1 if a position limit requires a
 * control outside the acceleration limits */
void dbk_control_bounds(const dbk_model *model, const dbk_real y[DBK_MAX_DOF], const dbk_real u_prev[DBK_MAX_DOF],
                        dbk_real lower[DBK_MAX_DOF], dbk_real upper[DBK_MAX_DOF], int32_t *conflict);

/* replaces the bounds at joint position y by those within the jerk limit; `u_change` is the previous change of the
 * control. Returns 0 if the jerk limit conflicts with the other limits of a joint, which then keeps its bounds */
int32_t dbk_jerk_bounds(const dbk_model *model, const dbk_real y[DBK_MAX_DOF], const dbk_real u_prev[DBK_MAX_DOF],
                        const dbk_real u_change[DBK_MAX_DOF], dbk_real lower[DBK_MAX_DOF], dbk_real upper[DBK_MAX_DOF]);

/* The largest change of the control of joint k in this period from which the acceleration can be reduced to zero within
 * the jerk limit before the control has changed by `room`, the distance to v_max. */
dbk_real dbk_velocity_ramp(const dbk_model *model, int32_t k, dbk_real room);

/* the braking control after u_prev */
void dbk_brake(const dbk_model *model, const dbk_real u_prev[DBK_MAX_DOF], dbk_real u[DBK_MAX_DOF]);

/* limits the jerk of a braking control, such that the deceleration ends at rest; joints without a jerk limit keep their
 * control */
void dbk_limit_brake_jerk(const dbk_model *model, const dbk_real u_prev[DBK_MAX_DOF],
                          const dbk_real u_change[DBK_MAX_DOF], dbk_real u[DBK_MAX_DOF]);

#endif
