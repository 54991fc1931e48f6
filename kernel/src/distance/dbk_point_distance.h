/* Distance from a point or a segment to another point, with the outward normal; inline, for loops over pairs. */
#ifndef DBK_POINT_DISTANCE_H
#define DBK_POINT_DISTANCE_H

#include "dbk_math.h"

#define DBK_MIN_DISTANCE ((dbk_real)1e-6) /* [m] at a smaller distance the direction is dominated by rounding */

/* distance from a point to (x, y, z), given relative to the point, and the unit vector toward (x, y, z) */
static inline dbk_real dbk_point_distance(dbk_real x, dbk_real y, dbk_real z, dbk_real *nx, dbk_real *ny,
                                          dbk_real *nz) {
  const dbk_real distance = dbk_sqrt(x * x + y * y + z * z);
  const dbk_real inverse = (dbk_real)1 / (distance > DBK_MIN_DISTANCE ? distance : DBK_MIN_DISTANCE);
  *nx = x * inverse;
  *ny = y * inverse;
  *nz = distance > DBK_MIN_DISTANCE ? z * inverse
                                    : (dbk_real)1; /* coincident points: every direction is a valid normal */
  return distance;
}

/* distance from a segment of half length `half` along the unit axis (ax, ay, az) to (x, y, z), given relative to the
 * middle of the segment, and the outward normal of the segment */
static inline dbk_real dbk_segment_distance(dbk_real x, dbk_real y, dbk_real z, dbk_real ax, dbk_real ay, dbk_real az,
                                            dbk_real half, dbk_real *nx, dbk_real *ny, dbk_real *nz) {
  const dbk_real along = x * ax + y * ay + z * az;
  const dbk_real low = along < half ? along : half;
  const dbk_real t = low > -half ? low : -half;
  return dbk_point_distance(x - t * ax, y - t * ay, z - t * az, nx, ny, nz);
}

#endif
