/* Enforcement of the supervisor's decisions: standstill, drive, and the checks of both.
 *
 * u = 0 once a HOLD or CONTROLLED_STOP has come to rest; the joints are monitored from then on. A CONTROLLED_STOP then
 * switches the drive off, an ESTOP at once. It is the state machine of `dualbrain.safety.supervisor.enforcement`.
 */
#ifndef DBK_STANDSTILL_H
#define DBK_STANDSTILL_H

#include <stdint.h>

#include "dbk/dbk_config.h"
#include "dbk/dbk_supervisor.h"

#ifdef __cplusplus
extern "C" {
#endif

#define DBK_REST_VELOCITY ((dbk_real)0.01) /* [rad/s] below it the arm is at rest */
#define DBK_MAX_DRIFT ((dbk_real)0.01)     /* [rad] allowed motion in a standstill */
#define DBK_STOP_TIMEOUT_US 800000u        /* longest duration of braking */
#define DBK_BRAKE_TIME_US 400000u          /* time in which the brakes stop the arm */
#define DBK_BRAKE_TIME ((dbk_real)0.4)     /* the same [s] */
#define DBK_MAX_BRAKE_SLIP ((dbk_real)0.03) /* [rad] allowed motion beyond the coasting distance in that time */

typedef struct {
  uint8_t drive_wanted, at_standstill, stopping, drive_off_known;
  uint64_t stop_since_us, drive_off_us;
  dbk_real standstill_q[DBK_MAX_DOF], drive_off_q[DBK_MAX_DOF], coast_limit[DBK_MAX_DOF];
} dbk_standstill;

void dbk_standstill_init(dbk_standstill *s);

/* Applies a decision at the measured state of `n` joints with the stamp `stamp_us`. Sets drive_wanted and
 * at_standstill. While the arm is `yielding` to a contact, its stop has not begun. Returns the conditions of a violated
 * stop or standstill. Displacements are per joint. */
uint64_t dbk_standstill_apply(dbk_standstill *s, dbk_decision decision, int yielding, int32_t n,
                              const dbk_real *q, const dbk_real *v, uint64_t stamp_us);

#ifdef __cplusplus
}
#endif
#endif
