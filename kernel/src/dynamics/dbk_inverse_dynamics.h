/* Inverse dynamics of an arm: the joint torques of its own motion and weight. */
#ifndef DBK_INVERSE_DYNAMICS_H
#define DBK_INVERSE_DYNAMICS_H

#include "dbk_math.h"

/* mass [kg], centre [m] and inertia about it (xx, yy, zz, xy, xz, yz) [kg m^2] of all bodies on one frame */
typedef struct {
  dbk_real mass, centre[3], inertia[6];
} dbk_body;

/* the dynamic model of an arm with n joints; the rotation of a joint is row-major, parent <- joint at q = 0 */
typedef struct {
  int32_t n, joint_kind[DBK_MAX_DOF];
  dbk_real joint_rotation[DBK_MAX_DOF][9], joint_offset[DBK_MAX_DOF][3];
  dbk_body body[DBK_MAX_DOF];
  dbk_real rotor_inertia[DBK_MAX_DOF], damping[DBK_MAX_DOF];
  dbk_real tool_offset[3]; /* origin of the tool frame in the last frame [m] */
} dbk_dynamics;

/* angular velocity, angular acceleration and linear acceleration of a frame, in its axes; gravity counts as an upward
 * acceleration of the base */
typedef struct {
  dbk_real spin[3], turn[3], linear[3];
} dbk_frame_motion;

/* torques [Nm; of a prismatic joint N]: `own` moves the arm, `per_load` moves 1 kg at the origin of the tool frame;
 * `wrist` and `wrist_per_load` are force [N] and torque [Nm] on the last frame, in its axes and about its origin */
typedef struct {
  dbk_real own[DBK_MAX_DOF], per_load[DBK_MAX_DOF], wrist[6], wrist_per_load[6];
} dbk_arm_torque;

/* positions q, velocities v and accelerations a of the joints of an arm on a base with the motion `base` */
void dbk_inverse_dynamics(const dbk_dynamics *arm, const dbk_frame_motion *base, const dbk_real q[DBK_MAX_DOF],
                          const dbk_real v[DBK_MAX_DOF], const dbk_real a[DBK_MAX_DOF], dbk_arm_torque *torque);

#endif
