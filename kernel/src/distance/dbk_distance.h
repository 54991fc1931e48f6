/* Signed distance and outward normal from points to one obstacle. */
#ifndef DBK_DISTANCE_H
#define DBK_DISTANCE_H

#include "dbk_math.h"

/* signed distances d and unit normals (nx, ny, nz) of `count` points (x, y, z) */
void dbk_distance(const dbk_obstacle *shape, int32_t count, const dbk_real *x, const dbk_real *y, const dbk_real *z,
                  dbk_real *d, dbk_real *nx, dbk_real *ny, dbk_real *nz);

#endif
