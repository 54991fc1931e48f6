/* Plausibility of joint states: late, repeated, implausible, or inconsistent with the commands.
 *
 * It is `dualbrain.safety.supervisor.state_monitor` for arms with a fixed base, with the same operations in float64.
 */
#ifndef DBK_STATE_MONITOR_H
#define DBK_STATE_MONITOR_H

#include "dbk_control_data.h"

typedef struct {
  int32_t n, received, plausible; /* 1: a state arrived; a plausible one */
  uint64_t last_sequence;
  double last_stamp; /* [s] of the last plausible state */
  double last_q[DBK_MAX_DOF], last_v[DBK_MAX_DOF];
  double u[DBK_MAX_DOF]; /* the control that was written last */
  double expected_velocity[DBK_MAX_DOF], source_gap[DBK_MAX_DOF], tracking_gap[DBK_MAX_DOF];
} dbk_state_monitor;

void dbk_state_monitor_init(dbk_state_monitor *m, int32_t n);

/* conditions of a joint state that was read at `now` [s] */
uint64_t dbk_check_state(dbk_state_monitor *m, const dbk_control_limits *limits, const dbk_joint_state *state,
                         double now);

/* conditions of the age of the last plausible state */
uint64_t dbk_check_state_age(const dbk_state_monitor *m, const dbk_control_limits *limits, double now);

/* conditions of a control that is about to be written */
uint64_t dbk_check_control(dbk_state_monitor *m, const dbk_control_limits *limits, const double *u);

#endif
