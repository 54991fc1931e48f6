/* The damped pseudo-inverse of a Jacobian, which is finite at singular postures. */
#ifndef DBK_DAMPED_INVERSE_H
#define DBK_DAMPED_INVERSE_H

#include "dbk_math.h"

#define DBK_MAX_TASK 6 /* rows of a Jacobian */

/* map = (J J' + lambda^2 1)^-1 J for a Jacobian (m, n) of m <= DBK_MAX_TASK rows; `damping` is lambda^2 > 0. The
 * transpose of the map is the pseudo-inverse. NaN if J is not finite */
void dbk_damped_map(int32_t m, int32_t n, const dbk_real (*jacobian)[DBK_MAX_DOF], dbk_real damping,
                    dbk_real (*map)[DBK_MAX_DOF]);

#endif
