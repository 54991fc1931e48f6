/* dualbrain supervisor: maps the conditions of a tick to one decision, in integers only.
 *
 *   decision(t) = strongest check whose condition lasted for `after` and that has not cleared since
 *
 * It is the state machine of `dualbrain.safety.supervisor.supervisor` with the same table of checks: equal times and
 * conditions give equal decisions. The caller owns the memory. Times are in microseconds.
 */
#ifndef DBK_SUPERVISOR_H
#define DBK_SUPERVISOR_H

#include <stdint.h>

#include "dbk/dbk_conditions.h"

#ifdef __cplusplus
extern "C" {
#endif

/* actions by severity, as `SafetyAction` */
enum {
  DBK_ACTION_NONE,
  DBK_ACTION_WARN,
  DBK_ACTION_SLOW,
  DBK_ACTION_HOVER,
  DBK_ACTION_HOLD,
  DBK_ACTION_CONTROLLED_STOP,
  DBK_ACTION_ESTOP,
  DBK_ACTION_LOCKOUT
};

/* how a tripped check clears, as `ClearPolicy` */
enum { DBK_WHEN_GONE, DBK_ON_CONTINUE, DBK_ON_RESUME, DBK_ON_TWO_STEP_RESET, DBK_ON_RESTART };

#define DBK_MAX_STEP_US 100000u /* largest time step of one update: a clock jump neither trips nor clears a check */
#define DBK_RESET_HELD DBK_N_CHECKS /* index of the state after a two-step reset */
#define DBK_NO_CHECK 255u

typedef struct {
  uint64_t condition;          /* bits of dbk_conditions.h */
  uint32_t after_us, release_us;
  uint8_t action, clears;
  uint8_t ends_contract;       /* 1: a running contract ends */
  uint8_t immediate_drive_off; /* 1: the drive is switched off at once, for any action */
} dbk_check;

/* the checks in the order of severity; generated from the table of the host */
extern const dbk_check dbk_checks[DBK_N_CHECKS];

typedef struct {
  uint8_t action, check; /* check: index of the strongest tripped check, DBK_NO_CHECK if none */
  uint8_t immediate_drive_off, ends_contract;
} dbk_decision;

typedef struct {
  uint64_t active_since[DBK_N_CHECKS], gone_since[DBK_N_CHECKS]; /* internal time, UINT64_MAX: never */
  uint8_t tripped[DBK_N_CHECKS];
  uint8_t started, reset_held;
  uint64_t now_us, time_us; /* last time passed, and internal time */
  uint64_t pressed;         /* buttons of the last update */
  dbk_decision decision;
} dbk_supervisor;

void dbk_supervisor_init(dbk_supervisor *s);

/* the decision of this tick; `now_us` need not be monotonic */
dbk_decision dbk_supervisor_update(dbk_supervisor *s, uint64_t now_us, uint64_t conditions);

#ifdef __cplusplus
}
#endif
#endif
