/* Forward kinematics of the chain, sphere centres and the geometric Jacobian. */
#ifndef DBK_KINEMATICS_H
#define DBK_KINEMATICS_H

#include "dbk_math.h"

/* sine and cosine of a joint angle x [rad], without libm */
void dbk_sincos(dbk_real x, dbk_real *sine, dbk_real *cosine);

/* sets frame 0: the pose of a mobile base, else the identity */
void dbk_base_frame(const dbk_in *in, dbk_frames *frames);

/* sets frames 1..n from the joint positions; frame 0 must be set */
void dbk_fk(const dbk_model *model, const dbk_real q[DBK_MAX_DOF], dbk_frames *frames);

/* centres and radii of the robot's spheres at a gripper opening [m], followed by those of the held object */
void dbk_spheres(const dbk_model *model, const dbk_scene *scene, const dbk_frames *frames, dbk_real opening,
                 dbk_sphere_set *spheres);

/* geometric Jacobian of a point fixed to the last frame */
void dbk_jacobian(const dbk_model *model, const dbk_frames *frames, const dbk_real point[3],
                  dbk_real linear[3][DBK_MAX_DOF], dbk_real angular[3][DBK_MAX_DOF]);

#endif
