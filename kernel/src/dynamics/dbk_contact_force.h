/* The contact force at a point of an arm that explains the external joint torques best. */
#ifndef DBK_CONTACT_FORCE_H
#define DBK_CONTACT_FORCE_H

#include "dbk_math.h"

/* force [N] = map * torque; `unexplained` is |r - J'F|^2 [Nm^2] and `cost` adds lambda^2 |F|^2 */
typedef struct {
  dbk_real force[3], map[3][DBK_MAX_DOF], unexplained, cost;
} dbk_contact_force;

/* the damped least-squares force at a point with the Jacobian `jacobian`, for the external torques `torque` (n):
 *
 *   F = (J J' + lambda^2 1)^-1 J r,     damping = lambda^2
 */
void dbk_solve_contact_force(int32_t n, const dbk_real jacobian[3][DBK_MAX_DOF], const dbk_real torque[DBK_MAX_DOF],
                             dbk_real damping, dbk_contact_force *contact);

/* the index of the point, out of `count` points (x, y, z), whose force has the least cost; `linear` and `angular` are
 * the Jacobian of the point `tool`, and joint_count[i] joints are before point i. -1 without a point */
int32_t dbk_locate_contact(int32_t n, const dbk_real linear[3][DBK_MAX_DOF], const dbk_real angular[3][DBK_MAX_DOF],
                           const dbk_real tool[3], int32_t count, const dbk_real (*points)[3],
                           const int32_t *joint_count, const dbk_real torque[DBK_MAX_DOF], dbk_real damping,
                           dbk_contact_force *contact);

#endif
