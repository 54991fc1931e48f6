/* Simulated arm: joints that follow the commanded velocity with a lag, and brake while the drive is off.
 *
 *   v <- v + (u - v) dt / lag,   q <- q + (v_before + v) dt / 2
 */
#ifndef DBK_SIMULATED_ARM_H
#define DBK_SIMULATED_ARM_H

#include "drivers/dbk_driver.h"

#define DBK_COMMAND_TIMEOUT_US 20000u /* without a command for this time the arm brakes, as a vendor's controller */

typedef struct {
  int32_t n, drive;
  uint64_t sequence, now_us, command_us;
  double lag;
  double q[DBK_MAX_DOF], v[DBK_MAX_DOF], u[DBK_MAX_DOF], braking[DBK_MAX_DOF]; /* braking: [rad/s^2] */
} dbk_simulated_arm;

/* at rest in `q` with the drive on */
dbk_driver dbk_simulated_arm_init(dbk_simulated_arm *a, int32_t n, const double *q, const double *braking, double lag);

#endif
