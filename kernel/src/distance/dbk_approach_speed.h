/* The speed at which two bodies at distance h may approach each other without the motion of the other body. */
#ifndef DBK_APPROACH_SPEED_H
#define DBK_APPROACH_SPEED_H

#include "dbk_math.h"

/* Returns 2 g h - C / (4 g) with the rate g = min a/v at which every joint can brake, and the second derivative -C <= 0
 * of h at constant u, given as the sampling term dt/2 C. If the joints brake along the path of the present control,
 * u(t) = (1 - g t) u, the path advances by 1/(2 g) seconds of the present motion until the robot is at rest. The
 * distance decreases by no more than s/(2 g) + C/(8 g^2) along it, which this speed s keeps at or below h. */
static inline dbk_real dbk_stopping_speed(dbk_real braking_gain, dbk_real arc_share, dbk_real h,
                                          dbk_real sampling_term) {
  return braking_gain * h - arc_share * sampling_term;
}

/* Returns min(alpha h, max(0, stopping speed)): no retreat is demanded from h >= 0. A NaN is returned. */
static inline dbk_real dbk_approach_speed(dbk_real alpha, dbk_real braking_gain, dbk_real arc_share, dbk_real h,
                                          dbk_real sampling_term) {
  const dbk_real linear = alpha * h, along_arc = dbk_stopping_speed(braking_gain, arc_share, h, sampling_term);
  const dbk_real stop = along_arc < (dbk_real)0 ? (dbk_real)0 : along_arc;
  return linear < stop ? linear : stop;
}

#endif
